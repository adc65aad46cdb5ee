"""MuJoCo's data, captured bit for bit. Imports MuJoCo only to restore what was captured of it."""

import hashlib
from typing import Any

from sb3_tdc.resume.walk import Capture, NotCapturedError, NotRestoredError, Restore, existing_as


def is_mujoco(name: str) -> Any:
    """Return whether a value is one of MuJoCo's of this name."""
    return lambda value: type(value).__name__ == name and type(value).__module__.startswith("mujoco")


def _model_bytes(model: Any) -> bytes:
    return model.__getstate__()


def capture_mj_data(data: Any) -> dict[str, Any]:
    """Capture MuJoCo's own bytes of the whole ``MjData``, without the model that it puts among them."""
    whole, model = data.__getstate__(), _model_bytes(data.model)
    before, found, after = whole.partition(model)
    if not found:
        raise NotCapturedError("MuJoCo's bytes of an MjData do not contain its model")
    return {"before": before, "after": after, "model": hashlib.sha256(model).hexdigest()}


def restore_mj_data(existing: Any, state: dict[str, Any]) -> Any:
    """Give an existing ``MjData`` its state, if it is of the same model; return it, or another with this state."""
    import mujoco

    model = _model_bytes(existing_as(mujoco.MjData, existing, "MjData").model)
    if hashlib.sha256(model).hexdigest() != state["model"]:
        raise NotRestoredError("the environment has another MuJoCo model now, or has changed its model")
    source = mujoco.MjData.__new__(mujoco.MjData)
    source.__setstate__(state["before"] + model + state["after"])
    if not hasattr(mujoco, "mj_copyData"):  # MuJoCo before 3.5 cannot copy into it from Python
        return source
    mujoco.mj_copyData(existing, existing.model, source)
    return existing


def capture_mj_model(context: Capture, model: Any, path: str) -> None:
    """Note that views of it are not the run's."""
    context.owners.append(model.body_mass.base)


def restore_mj_model(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return the existing model."""
    import mujoco

    return existing_as(mujoco.MjModel, existing, path)
