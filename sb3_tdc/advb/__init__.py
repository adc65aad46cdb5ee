from sb3_tdc.advb.algorithms import AdvBSAC, AdvBTD3, AdvBTDC
from sb3_tdc.advb.callback import BoardCallback

__all__ = ["AdvBSAC", "AdvBTD3", "AdvBTDC", "BoardCallback"]
