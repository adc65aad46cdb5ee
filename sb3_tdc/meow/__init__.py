from sb3_tdc.meow.meow import MEOW
from sb3_tdc.meow.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["MEOW", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
