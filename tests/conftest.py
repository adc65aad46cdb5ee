import multiprocessing

import torch as th

th.set_num_threads(1)
# Processes of environments start as copies of one that has imported these, which takes seconds
multiprocessing.set_forkserver_preload(["tests.tools.runs"])
