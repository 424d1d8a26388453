"""Time H and ∇H of frax (JAX) on this device: ``frax_peer.py URDF ROOT float|double ROWS``.

H is computed from the mass matrix and the Jacobian of frax by a Cholesky factorization, and ∇H by JAX.  The contact
point is the origin of the last joint, which needs the fewest operations.
"""

from __future__ import annotations

import json
import sys
import time
import warnings

import jax
import jax.numpy as jnp

urdf, root, real, rows = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])
warnings.filterwarnings("ignore")
jax.config.update("jax_enable_x64", real == "double")

import frax  # noqa: E402 - it makes arrays at its import

floating = root == "free-flyer"
robot = frax.Robot(urdf, floating_base="quaternion") if floating else frax.Robot(urdf)
dtype = jnp.float64 if real == "double" else jnp.float32
normal = jnp.array([0.0, 0.0, 1.0], dtype)
armature = jnp.full((robot.nv,), 0.1, dtype).at[: 6 * floating].set(0)


def H(q: jax.Array) -> jax.Array:
    transforms = robot.joint_to_world_transforms(q)
    mass = robot._mass_matrix(transforms) + jnp.diag(armature)
    jacobian = robot._joint_jacobians(transforms)[0][-1]
    jacobian = jacobian.reshape(3, robot.nv) if jacobian.shape[0] == 3 else jacobian.T
    a = jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(mass), jacobian.T @ normal)
    return a @ a


q = jax.random.uniform(jax.random.PRNGKey(0), (rows, robot.nq), dtype, -1, 1)
if floating:
    q = q.at[:, 3:7].set(q[:, 3:7] / jnp.linalg.norm(q[:, 3:7], axis=1, keepdims=True))
both = jax.jit(jax.vmap(jax.value_and_grad(H)))
began = time.perf_counter()
jax.block_until_ready(both(q))
compile_s, times = time.perf_counter() - began, []
for _ in range(7):
    began = time.perf_counter()
    jax.block_until_ready(both(q))
    times.append(time.perf_counter() - began)
print(json.dumps({"million": rows / sorted(times)[3] / 1e6, "compile_s": compile_s, "device": str(jax.devices()[0])}))
