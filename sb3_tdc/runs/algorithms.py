"""The algorithms that a run can use, by name: those of the package, and the variants that the experiments compare."""

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_tdc.ablations import ABLATIONS
from sb3_tdc.algorithms import ALGORITHMS

KNOWN_ALGORITHMS: dict[str, type[OffPolicyAlgorithm]] = {**ALGORITHMS, **ABLATIONS}
