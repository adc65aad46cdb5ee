"""The guards of TDC and MEOW for other algorithms: values that are not finite are neither learnt from nor saved."""

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tdc.common.finite import ADVICE, NonFiniteError, find_non_finite_weights, refuse_to_save
from sb3_tdc.common.off_policy import CheckedOffPolicyAlgorithm
from sb3_tdc.common.transitions import check_first_observation, check_transition
from sb3_tdc.common.words import first_of


class FiniteGuardCallback(BaseCallback):
    """A callback that raises ``NonFiniteError`` before a transition that is not finite is stored."""

    is_captured = False

    def _on_training_start(self) -> None:
        check_first_observation(self.model)  # type: ignore[arg-type]

    def _on_step(self) -> bool:
        step = self.locals
        parts = (step[name] for name in ("buffer_actions", "new_obs", "rewards", "dones", "infos"))
        check_transition(self.model, *parts)  # type: ignore[arg-type]
        return True


def check_before_saving(model: BaseAlgorithm) -> None:
    """
    Check the weights of a model, if its own ``save`` does not.

    :raises NonFiniteError: if a weight is NaN or infinite
    """
    if not isinstance(model, CheckedOffPolicyAlgorithm):
        refuse_to_save(model, find_non_finite_weights(model))


@contextmanager
def divergence_named(model: BaseAlgorithm) -> Iterator[None]:
    """
    If this block raises, name the weights that are not finite: PyTorch's distributions do not name NaN as the cause.

    :raises NonFiniteError: if the block raises and weights are not finite
    """
    try:
        yield
    except NonFiniteError:
        raise
    except Exception as error:
        if broken := find_non_finite_weights(model):
            when = f"at timestep {model.num_timesteps}"
            raise NonFiniteError(f"The weights {first_of(broken)} are not finite {when}. {ADVICE}") from error
        raise
