"""From continuous to discrete time, exactly or by Euler.

x' = A x + B u + G d + w, with u and d held over a sample of length dt.
"""

import jax.numpy as jnp
from jax.scipy.linalg import expm
from jaxtyping import Array, Float

from holdfast.numerics.linalg import symmetric


def hold(
    A: Float[Array, "n n"], inputs: Float[Array, "n m"], dt: float
) -> tuple[Float[Array, "n n"], Float[Array, "n m"]]:
    """exp(A dt) and the integral of exp(A s) ds times ``inputs`` over a sample, together."""
    n, m = inputs.shape
    block = jnp.zeros((n + m, n + m)).at[:n, :n].set(A).at[:n, n:].set(inputs)
    power = expm(block * dt)
    return power[:n, :n], power[:n, n:]


def van_loan(A: Float[Array, "n n"], Q: Float[Array, "n n"], dt: float) -> Float[Array, "n n"]:
    """The integral of exp(A s) Q exp(A s)' ds over a sample: white noise of intensity Q."""
    n = A.shape[0]
    block = jnp.zeros((2 * n, 2 * n)).at[:n, :n].set(-A).at[:n, n:].set(Q).at[n:, n:].set(A.T)
    power = expm(block * dt)
    return symmetric(power[n:, n:].T @ power[:n, n:])


def sample(
    A: Float[Array, "n n"],
    inputs: Float[Array, "n m"],
    Q: Float[Array, "n n"],
    dt: float,
    method: str,
    noise: str,
) -> tuple[Float[Array, "n n"], Float[Array, "n m"], Float[Array, "n n"]]:
    """Discrete A, input matrices and Q.

    ``method`` "zoh" (exact) or "euler"; ``noise`` "held" (w constant over a sample, its effect
    has covariance Phi Q Phi', under Euler dt^2 Q) or "white" (Q an intensity: Van Loan under
    zoh, dt Q under Euler).
    """
    n = A.shape[0]
    if method == "euler":
        return jnp.eye(n) + dt * A, dt * inputs, Q * (dt * dt if noise == "held" else dt)
    columns = jnp.concatenate([inputs, jnp.eye(n)], 1)
    Ad, held = hold(A, columns, dt)
    phi = held[:, inputs.shape[1] :]
    Qd = symmetric(phi @ Q @ phi.T) if noise == "held" else van_loan(A, Q, dt)
    return Ad, held[:, : inputs.shape[1]], Qd
