"""The choice of the update that trains a model and computes its actions: the fused one where it applies."""

import operator
from typing import Any, ClassVar

import numpy as np

from sb3_tdc.common.off_policy import CheckedOffPolicyAlgorithm
from sb3_tdc.common.versions import numba_version
from sb3_tdc.tdc.fused.applicability import obstacles
from sb3_tdc.tdc.fused.update import FusedUpdate

# Methods that the fused update does not call, because it does their work itself
_FUSED_METHODS = (
    *("train", "update", "update_critics", "update_actor", "update_targets"),
    *("_sample_target_actions", "make_target", "_minimize", "predict"),
)
_methods_of = operator.attrgetter(*_FUSED_METHODS)


class FusedUpdateAlgorithm(CheckedOffPolicyAlgorithm):
    """
    An algorithm with a readable update, and with the same update on preallocated buffers (:class:`FusedUpdate`).

    The direct subclass, TDC, implements the readable update. If a subclass of TDC, or an instance, overrides one of the
    methods that the fused update does not call, the readable update is used.
    """

    fused: bool | None
    # These methods of the direct subclass, as they were when it was defined
    _readable_methods: ClassVar[tuple[Any, ...]]

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if FusedUpdateAlgorithm in cls.__bases__:
            cls._readable_methods = _methods_of(cls)

    def overrides_methods(self) -> bool:
        """Return whether the class or this instance overrides a method that the fused update would not call."""
        return _methods_of(type(self)) != self._readable_methods or not vars(self).keys().isdisjoint(_FUSED_METHODS)

    def overridden_methods(self) -> list[str]:
        """Return the names of these methods."""
        own = zip(_FUSED_METHODS, self._readable_methods, strict=True)
        return [name for name, method in own if getattr(type(self), name) is not method or name in vars(self)]

    def _setup_fused_update(self) -> None:
        self._fused_update: FusedUpdate | None = None
        self._obstacles = obstacles(self)
        if self._obstacles and self.fused:
            raise ValueError(self._obstacle_message())
        if self.verbose > 0 and self.fused is None:
            self._tell_which_update()

    @property
    def _own_fused_update(self) -> FusedUpdate | None:
        """Return the fused update that is bound to this model; a shallow copy also holds that of its original."""
        bound = self._fused_update
        return bound if bound is not None and bound.model is self else None

    def _bind_fused_update(self, batch_size: int) -> FusedUpdate | None:
        """Return the fused update, bound again if anything has changed, or None if the readable one is to be used."""
        bound = self._own_fused_update
        if bound is not None and self.fused is not False and bound.fits(batch_size):
            return bound
        self._fused_update = None
        if self.fused is False:
            return None
        known, self._obstacles = self._obstacles, obstacles(self)
        if not self._obstacles:
            self._fused_update = FusedUpdate(self, batch_size)
        elif self.fused:
            raise ValueError(self._obstacle_message())
        if self.verbose > 0 and known != self._obstacles:
            self._tell_which_update()
        return self._fused_update

    def _obstacle_message(self) -> str:
        return f"fused must be None or False here: {'; '.join(self._obstacles)}"

    def _tell_which_update(self) -> None:
        update = f"readable update ({'; '.join(self._obstacles)})" if self._obstacles else "fused update"
        numba = numba_version()
        loops = f"loops compiled by Numba {numba}" if numba else 'no compiled loops: pip install "sb3-tdc[fast]"'
        print(f"Using the {update}, {loops}")

    def prepare_to_continue(self) -> None:
        if self._n_updates > 0:
            self._bind_fused_update(self.batch_size)  # it also computes the actions

    def _sample_scaled_action(self, learning_starts: int, n_envs: int) -> np.ndarray:
        fused = self._own_fused_update
        if fused is None or self.num_timesteps < learning_starts or not fused.acts():
            return super()._sample_scaled_action(learning_starts, n_envs)
        scaled_action = fused.act(np.ascontiguousarray(self._last_obs))
        return scaled_action.reshape(-1, *self.action_space.shape)  # type: ignore[misc]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_obstacles", "_fused_update"]
