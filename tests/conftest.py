import os

os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")  # the tests compare bit for bit, on the CPU

import torch as th

th.set_num_threads(1)
