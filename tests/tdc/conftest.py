import pytest

from sb3_tdc.tdc import quantiles
from sb3_tdc.tdc.compiled import load_kernels
from sb3_tdc.tdc.fused import update


def use_loops(monkeypatch, kernels):
    for module in (quantiles, update):
        monkeypatch.setattr(module, "load_kernels", lambda: kernels)


@pytest.fixture(params=["compiled", "torch"])
def loops(request, monkeypatch):
    """The compiled loops of Numba, then PyTorch's own."""
    kernels = load_kernels() if request.param == "compiled" else None
    assert request.param == "torch" or kernels is not None
    use_loops(monkeypatch, kernels)


@pytest.fixture
def torch_loops(monkeypatch):
    use_loops(monkeypatch, None)
