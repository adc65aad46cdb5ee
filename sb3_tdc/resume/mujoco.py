"""Bit-exact capture of MuJoCo's data. MuJoCo is imported only when captured data are restored."""

import hashlib
from typing import Any

from sb3_tdc.resume.walk import Capture, NotCapturedError, NotRestoredError, Restore, existing_as


def is_mujoco(name: str) -> Any:
    """Return a function that tells whether a value is of MuJoCo's class of this name."""
    return lambda value: type(value).__name__ == name and type(value).__module__.startswith("mujoco")


def _model_bytes(model: Any) -> bytes:
    return model.__getstate__()


def capture_mj_data(data: Any) -> dict[str, Any]:
    """Capture the bytes to which MuJoCo serialises an ``MjData``, without the model that they contain."""
    whole, model = data.__getstate__(), _model_bytes(data.model)
    before, found, after = whole.partition(model)
    if not found:
        raise NotCapturedError("MuJoCo's bytes of an MjData do not contain its model")
    return {"before": before, "after": after, "model": hashlib.sha256(model).hexdigest()}


def restore_mj_data(existing: Any, state: dict[str, Any]) -> Any:
    """
    Restore the state of an existing ``MjData`` of the same model.

    :return: the existing ``MjData``, or a new one with this state if MuJoCo cannot copy into an existing one
    :raises NotRestoredError: if the model differs from the captured one
    """
    import mujoco

    model = _model_bytes(existing_as(mujoco.MjData, existing, "MjData").model)
    if hashlib.sha256(model).hexdigest() != state["model"]:
        raise NotRestoredError("the environment has another MuJoCo model now, or has changed its model")
    source = mujoco.MjData.__new__(mujoco.MjData)
    source.__setstate__(state["before"] + model + state["after"])
    if not hasattr(mujoco, "mj_copyData"):  # MuJoCo before 3.5 cannot copy into an existing one from Python
        return source
    mujoco.mj_copyData(existing, existing.model, source)
    return existing


def capture_mj_model(context: Capture, model: Any, path: str) -> None:
    """Note the model as the owner of its memory, so that the numbers in views of it are not captured."""
    context.owners.append(model.body_mass.base)


def restore_mj_model(context: Restore, content: Any, existing: Any, path: str) -> Any:
    """Return the existing model."""
    import mujoco

    return existing_as(mujoco.MjModel, existing, path)
