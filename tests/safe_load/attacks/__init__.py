"""
Files that ask for more than data: for each kind, a function ``make(folder, model)`` writes one and returns its path.

``python -m tests.safe_load.attacks MODEL.zip [NAME ...]`` opens them one after the other in its process, and prints
the time and the memory that each took; the tests run it in a child process.
"""

from tests.safe_load.attacks import buffers, data, folders, pickles, tensors, zips

ATTACKS = {
    f"{module.__name__.rpartition('.')[2]}: {name}": make
    for module in (pickles, data, tensors, zips, buffers, folders)
    for name, make in module.ATTACKS.items()
}
