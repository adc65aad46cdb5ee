"""
The update of ``tdc.py`` on static buffers, for plain ReLU networks: no autograd, no allocation, flat parameters.

The weights of the policy become views of one flat tensor per optimizer, as do their gradients and Adam's moments, so
that an optimizer step and a Polyak step are one call each. What is computed is ``TDC.update_critics`` and
``TDC.update_actor`` to float32 rounding, on the same random numbers; the backward passes are derived by hand.
"""

from sb3_tdc.tdc.fused.applicability import obstacles
from sb3_tdc.tdc.fused.update import FusedUpdate

__all__ = ["FusedUpdate", "obstacles"]
