"""The commands of this package as the user types them, for messages that name one."""

import shlex
import sys
from pathlib import Path


def command(name: str, *arguments: object) -> str:
    """
    Return a command as the user would type it.

    :param name: ``train``, ``enjoy``, ...
    :param arguments: arguments of the command, which are quoted
    :return: ``python train.py …``, ``python -m sb3_tdc train …`` or ``sb3-tdc train …``, depending on how this process
        was started
    """
    program = Path(sys.argv[0])
    script = program.with_name(f"{name}.py")
    if program.name in ("train.py", "enjoy.py", "tune.py"):
        words = ["python", str(script)] if script.is_file() else ["python", "-m", "sb3_tdc", name]
    elif program.parts[-2:] == ("sb3_tdc", "__main__.py"):
        words = ["python", "-m", "sb3_tdc", name]
    else:
        words = ["sb3-tdc", name]
    return shlex.join([*words, *map(str, arguments)])
