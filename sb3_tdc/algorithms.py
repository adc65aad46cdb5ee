"""The algorithms of the commands, by name."""

from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_tdc.advb import AdvBSAC, AdvBTD3, AdvBTDC
from sb3_tdc.meow import MEOW
from sb3_tdc.tdc import TDC

ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {
    "tdc": TDC,
    "meow": MEOW,
    "td3": TD3,
    "sac": SAC,
    "ddpg": DDPG,
    "advb_td3": AdvBTD3,
    "advb_sac": AdvBSAC,
    "advb_tdc": AdvBTDC,
}
