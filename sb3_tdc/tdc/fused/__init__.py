"""
The update of ``tdc.py`` on preallocated buffers, for plain ReLU networks: no autograd, no allocation.

It computes the same as ``TDC.update_critics``, ``TDC.update_actor`` and ``TDC.update_targets`` up to float32 rounding,
from the same random numbers, with backward passes derived by hand. Parameters, targets and optimizer state keep their
storage. If anything has changed since the update was bound (``snapshot.py``), the model is examined again
(``applicability.py``), and the readable update takes over where the fused one does not apply (``algorithm.py``).

One transition is one row of a packed replay buffer and of the minibatch. The diagram shows what reads which columns::

    s | a | s' | r | d | t
    └─┬─┘   │    └───┬───┘
      │     │        target: r, and d − t (the end of an episode, unless it is a time-out)
      │     copied next to ã into [s' | ã]: target actor (s'), target critics (both)
      online critics (both); actor (s), which then overwrites a with its actions
"""

from sb3_tdc.tdc.fused.algorithm import FusedUpdateAlgorithm
from sb3_tdc.tdc.fused.update import FusedUpdate

__all__ = ["FusedUpdate", "FusedUpdateAlgorithm"]
