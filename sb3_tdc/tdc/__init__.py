from sb3_tdc.common.finite import NonFiniteError
from sb3_tdc.tdc.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_tdc.tdc.tdc import TDC

__all__ = ["TDC", "CnnPolicy", "MlpPolicy", "MultiInputPolicy", "NonFiniteError"]
