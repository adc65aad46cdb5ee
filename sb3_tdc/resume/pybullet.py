"""Bit-exact capture of PyBullet's worlds in its own format, through existing clients. PyBullet is not imported."""

import tempfile
from pathlib import Path
from typing import Any

from sb3_tdc.resume.walk import MISSING, NotCapturedError, NotRestoredError


def is_client(value: Any) -> bool:
    """Return whether a value is a client: a connection to a PyBullet world."""
    return type(value).__name__ == "BulletClient" and type(value).__module__.startswith("pybullet_utils")


def capture_world(client: Any) -> dict[str, Any]:
    """
    Capture positions, velocities, contacts with the impulses that the solver starts from, and the list of bodies.

    :raises NotCapturedError: if PyBullet cannot save its world, or if several bodies move: after PyBullet's file is
        loaded, contacts between them continue differently
    """
    moving = [n for n in range(client.getNumBodies()) if _moves(client, n)]
    if len(moving) > 1:
        raise NotCapturedError(f"PyBullet does not save all of a world in which {len(moving)} bodies move")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.bullet"
        client.saveBullet(str(file))
        if not file.is_file():
            raise NotCapturedError("PyBullet cannot save its world")
        return {"bodies": _bodies(client), "world": file.read_bytes()}


def restore_world(existing: Any, state: dict[str, Any]) -> Any:
    """
    Restore the state of an existing world with the same bodies.

    :return: the client of the world
    :raises NotRestoredError: if there is no world, or if it has other bodies
    """
    if existing is MISSING or not is_client(existing):
        raise NotRestoredError("there is no PyBullet world to be restored")
    if _bodies(existing) != state["bodies"]:
        raise NotRestoredError("PyBullet's world has other bodies now")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "world.bullet"
        file.write_bytes(state["world"])
        existing.restoreState(fileName=str(file))
    return existing


def _moves(client: Any, body: int) -> bool:
    links = range(-1, client.getNumJoints(body))
    return any(client.getDynamicsInfo(body, link)[0] > 0 for link in links)


def _bodies(client: Any) -> list[str]:
    """Return the names and numbers of joints of all bodies, in the order in which they were loaded."""
    return [f"{client.getBodyInfo(n)}, {client.getNumJoints(n)} joints" for n in range(client.getNumBodies())]
