"""Table of all kinds of values, in the order in which they are tried. Most match one class, without its subclasses."""

import functools
import random
import types
from collections import deque

import numpy as np
import torch as th

from sb3_tdc.common.words import count
from sb3_tdc.resume import environments, mujoco, pybullet
from sb3_tdc.resume.kinds import arrays, containers, generators, objects
from sb3_tdc.resume.walk import Kind, Kinds, name_of, plain

KINDS: Kinds = {
    "integer": Kind(
        lambda v: type(v) is int, lambda context, v, path: hex(v), arrays.restore_integer, has_identity=False
    ),
    "text": Kind(
        lambda v: type(v) is str,
        lambda context, v, path: v.encode("utf-8", "surrogatepass").hex(),
        arrays.restore_text,
        has_identity=False,
    ),
    "value": Kind(arrays.is_made, arrays.capture_made, arrays.restore_made, has_identity=False),
    "numbers": Kind(
        containers.is_long_list_of_numbers,
        lambda context, v, path: context.add_array(np.array(v)),
        containers.restore_numbers,
    ),
    "list": Kind(
        lambda v: type(v) is list,
        containers.capture_items,
        containers.restore_list,
        children=containers.items_of,
    ),
    "tuple": Kind(
        lambda v: type(v) is tuple,
        containers.capture_items,
        containers.restore_tuple,
        has_identity=False,
        children=containers.items_of,
    ),
    "named tuple": Kind(
        containers.is_named_tuple,
        containers.capture_named_tuple,
        containers.restore_named_tuple,
        has_identity=False,
        needs=containers.needs_of_named_tuple,
        children=lambda content: containers.items_of(content[1]),
    ),
    "dict": Kind(
        containers.is_dict,
        containers.capture_dict,
        containers.restore_dict,
        needs=containers.needs_of_dict,
        children=containers.children_of_dict,
    ),
    "set": Kind(lambda v: type(v) is set, containers.capture_set, containers.restore_set),
    "frozenset": Kind(
        lambda v: type(v) is frozenset,
        containers.capture_set,
        lambda *args: frozenset(containers.restore_set(*args)),
        has_identity=False,
    ),
    "deque": Kind(
        lambda v: type(v) is deque,
        containers.capture_deque,
        containers.restore_deque,
        children=lambda content: containers.items_of(content[1]),
    ),
    "array": Kind(
        lambda v: type(v) is np.ndarray,
        arrays.capture_array,
        arrays.restore_array,
        needs=arrays.needs_of_array,
        children=arrays.children_of_array,
    ),
    "number": Kind(
        lambda v: isinstance(v, np.generic),
        arrays.capture_number,
        lambda context, content, existing, path: context.array(content)[()],
        has_identity=False,
    ),
    "bytes": Kind(lambda v: type(v) is bytes, arrays.capture_bytes, arrays.restore_bytes, has_identity=False),
    "bytearray": Kind(lambda v: type(v) is bytearray, arrays.capture_bytes, arrays.restore_bytearray),
    "tensor": Kind(arrays.is_tensor, arrays.capture_tensor, arrays.restore_tensor),
    "generator": plain(
        lambda v: type(v) is np.random.Generator, generators.capture_generator, generators.restore_generator
    ),
    "random state": plain(
        lambda v: type(v) is np.random.RandomState,
        lambda v: {"state": v.get_state(legacy=False)},
        generators.restore_random_state,
    ),
    "python random": plain(
        lambda v: type(v) is random.Random, generators.capture_python_random, generators.restore_python_random
    ),
    "torch generator": plain(
        lambda v: type(v) is th.Generator,
        lambda v: {"state": v.get_state().numpy()},
        generators.restore_torch_generator,
    ),
    "text file": Kind(
        generators.is_written_file,
        generators.capture_text_file,
        generators.restore_text_file,
        needs=lambda content: "a file that is written to",
    ),
    "enum": Kind(
        objects.is_member,
        lambda context, v, path: [name_of(type(v)), v.name],
        objects.restore_member,
        has_identity=False,
        needs=objects.needs_of_member,
    ),
    "code": Kind(
        objects.is_code,
        lambda context, v, path: objects.code_name(v),
        objects.restore_code,
        has_identity=False,
        needs=objects.needs_of_code,
    ),
    "constant": Kind(
        objects.is_constant,
        lambda context, v, path: objects.describe_constant(v),
        objects.restore_constant,
        has_identity=False,
        needs=lambda content: content,
    ),
    "function": Kind(
        lambda v: type(v) is types.FunctionType,
        objects.capture_function,
        objects.restore_function,
        needs=lambda content: content["name"],
        children=objects.children_of_function,
    ),
    "method": Kind(
        lambda v: type(v) is types.MethodType,
        objects.capture_method,
        objects.restore_method,
        has_identity=False,
        needs=lambda content: content[0],
        children=lambda content: {".__self__": content[1]},
    ),
    "partial": Kind(
        lambda v: type(v) is functools.partial,
        objects.capture_partial,
        objects.restore_partial,
        children=lambda content: dict(zip((".func", ".args", ".keywords"), content, strict=True)),
    ),
    "optimizer": Kind(
        lambda v: isinstance(v, th.optim.Optimizer),
        objects.capture_optimizer,
        objects.restore_optimizer,
        needs=objects.needs_of_object,
        children=objects.attributes_in,
    ),
    "MjData": plain(
        mujoco.is_mujoco("MjData"),
        mujoco.capture_mj_data,
        mujoco.restore_mj_data,
        needs=lambda content: "MuJoCo's MjData",
        owner=lambda data: data.xpos.base,
    ),
    # Not captured itself: an environment with a model also has an MjData, which includes and compares a digest of it
    "MjModel": Kind(
        mujoco.is_mujoco("MjModel"),
        mujoco.capture_mj_model,
        mujoco.restore_mj_model,
        needs=lambda content: "MuJoCo's MjModel",
    ),
    "BulletClient": plain(
        pybullet.is_client,
        pybullet.capture_world,
        pybullet.restore_world,
        needs=lambda content: "a PyBullet world",
    ),
    "environments": Kind(
        environments.is_vec_env,
        environments.capture_vec_env,
        environments.restore_vec_env,
        needs=lambda content: count(len(content[0]), "environment"),
    ),
    "vectorised environments": Kind(
        environments.is_other_vec_env,
        environments.capture_other_vec_env,
        environments.restore_other_vec_env,
        needs=lambda content: f"a {content['class']}",
    ),
    "event files": Kind(
        environments.is_event_files,
        environments.capture_output,
        environments.restore_output,
        needs=lambda content: "TensorBoard's event files",
    ),
    "object": Kind(
        objects.is_python_object,
        objects.capture_object,
        objects.restore_object,
        needs=objects.needs_of_object,
        children=objects.attributes_in,
    ),
}
