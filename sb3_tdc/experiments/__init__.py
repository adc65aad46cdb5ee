import sys

try:
    import jinja2  # noqa: F401
    import matplotlib  # noqa: F401
    import pandas  # noqa: F401
    import scipy  # noqa: F401
except ImportError as error:
    message = f'The experiments need more packages ({error.name}): pip install "sb3-tdc[report]"'
    if sys.argv[0] == "-m":  # python -m experiments.…: a sentence, not a traceback
        raise SystemExit(message) from error
    raise ImportError(message) from error
