"""
Files that ask for more than data: for each kind a generator, ``make(folder, model)``, which writes one.

``python -m tests.safe_load.attacks MODEL.zip [NAME ...]`` opens them one after the other in its process, and prints
what each took; the tests run it in a child.
"""

from tests.safe_load.attacks import buffers, data, folders, pickles, tensors, zips

ATTACKS = {
    f"{module.__name__.rpartition('.')[2]}: {name}": make
    for module in (pickles, data, tensors, zips, buffers, folders)
    for name, make in module.ATTACKS.items()
}
