"""The finite guards of TDC and MEOW, for the other algorithms: nothing that is not finite is learnt from or saved."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tdc.common.checks import find_non_finite
from sb3_tdc.common.transitions import check_first_observation, check_transition
from sb3_tdc.common.words import count
from sb3_tdc.tdc import NonFiniteError


class FiniteGuard(BaseCallback):
    """End training with a ``NonFiniteError`` before a transition that is not finite is stored."""

    is_captured = False

    def _on_training_start(self) -> None:
        check_first_observation(self.model)  # type: ignore[arg-type]

    def _on_step(self) -> bool:
        step = self.locals
        parts = (step[name] for name in ("buffer_actions", "new_obs", "rewards", "dones", "infos"))
        check_transition(self.model, *parts)  # type: ignore[arg-type]
        return True


def check_weights(model: BaseAlgorithm, path: Path) -> None:
    """
    Look at what is about to be saved.

    :raises NonFiniteError: if a weight is NaN or infinite
    """
    if broken := _non_finite_weights(model):
        raise NonFiniteError(f"{path} was not written: the weights {', '.join(broken)} are not finite.")


@contextmanager
def divergence_named(model: BaseAlgorithm) -> Iterator[None]:
    """
    Name the weights that cause an error in this block: PyTorch's distributions do not say that they were given NaN.

    :raises NonFiniteError: if weights are not finite
    """
    try:
        yield
    except NonFiniteError:
        raise
    except Exception as error:
        if broken := _non_finite_weights(model):
            raise NonFiniteError(
                f"The weights {', '.join(broken)} are not finite at timestep {model.num_timesteps}. Training has "
                "stopped. Look for extreme rewards or observations, or lower the learning rates."
            ) from error
        raise


def _non_finite_weights(model: BaseAlgorithm) -> list[str]:
    _, names = model._get_torch_save_params()
    broken = find_non_finite(model.policy, model.policy.state_dict())
    broken += [name for name in names if not th.as_tensor(getattr(model, name)).isfinite().all()]
    return broken if len(broken) <= 3 else [*broken[:3], f"and {count(len(broken) - 3, 'other')}"]
