try:
    import jinja2  # noqa: F401
    import matplotlib  # noqa: F401
    import pandas  # noqa: F401
    import scipy  # noqa: F401
except ImportError as error:
    raise ImportError(f'The experiments need more packages ({error.name}): pip install "sb3-tdc[report]"') from error
