"""``sb3-tdc COMMAND``, or ``python -m sb3_tdc COMMAND``."""

import importlib
import sys
from collections.abc import Sequence
from importlib.metadata import version

from sb3_tdc.common.commands import command
from sb3_tdc.common.output import harmless_output
from sb3_tdc.common.untrusted import escaped

COMMANDS = {
    "train": "train an agent, or resume a run",
    "enjoy": "watch, record or explain a trained agent",
    "plot": "draw the learning curves of runs",
    "inspect": "show what a saved file holds, without running any of it",
    "tune": "search hyperparameters",
    "matrix": "train the runs of a figure of the paper, several at once",
    "evaluate": "play test episodes with every finished run",
    "report": "make one page of all runs in some folders",
    "publish": "copy the small files of finished runs into a folder to commit",
}
_USAGE = "usage: sb3-tdc COMMAND [ARGUMENTS], or sb3-tdc COMMAND --help\n\n" + "\n".join(
    f"  {name:10}{what}" for name, what in COMMANDS.items()
)
_STARTED_BY_OTHERS = ("job",)


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run a command. Ctrl-C, a closed pipe, and a file that cannot be read or written end it without a traceback.

    :param argv: name and arguments of the command; by default, those of the process
    :return: the exit status of the command
    """
    name, *arguments = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    try:
        try:
            return _run(name, arguments)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()  # a closed pipe can still be handled here
    except KeyboardInterrupt:
        status, sentence = 130, "Stopped."
    except BrokenPipeError:  # the reader has seen enough: sb3-tdc enjoy ... | head -1
        status, sentence = 128 + 13, ""  # as if SIGPIPE had ended it
    except OSError as error:
        reason = error.strerror or " ".join(str(error).split())
        place = f"{error.filename}: " if error.filename is not None else ""
        status, sentence = 1, f"{command(name)}: error: {escaped(f'{place}{reason}')}"
    with harmless_output():
        if sentence:
            print(sentence, file=sys.stderr)
    return status


def _run(name: str, arguments: Sequence[str]) -> int:
    if name in ("-h", "--help"):
        print(_USAGE)
        return 0
    if name == "--version":
        print(f"sb3-tdc {version('sb3-tdc')}")
        return 0
    if name not in (*COMMANDS, *_STARTED_BY_OTHERS):
        from sb3_tdc.common.checks import suggest  # imports PyTorch

        print(f"sb3-tdc: error: unknown command {name!r}{suggest(name, COMMANDS)}\n{_USAGE}", file=sys.stderr)
        return 2
    try:
        module = importlib.import_module(f"sb3_tdc.cli.{name}")
    except ImportError as error:  # its message has the command that installs the missing package
        print(f"{command(name)}: error: {error}", file=sys.stderr)
        return 2
    return module.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
