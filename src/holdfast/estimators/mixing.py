"""The interaction of a bank's filters before a row: each starts from all, as the chain has it.

With T_ij the probability that mode i at one row is followed by mode j at the next, and p_i that
of mode i after the row before, filter j starts from the moments of the mixture

    w_ij = T_ij p_i / sum_i T_ij p_i,    x_j <- sum_i w_ij x_i,
    P_j <- sum_i w_ij (P_i + (x_i - x_j)(x_i - x_j)').

Without it a filter whose mode was wrong for a while goes on from what falsified samples have
left of it when the mode is right again. What filter j knows of its own mode's attacks stays:
whoever comes from another mode has them with the same moments, independent of the state.

Source: Blom and Bar-Shalom, IEEE Trans. Automatic Control 33 (1988), (6)-(8).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from holdfast.estimators.bank import Covariances, Means
from holdfast.parts import InvalidValue


def mixed(
    means: Means, cov: Covariances, log_p: Float[Array, " s"], transition: Float[Array, "s s"]
) -> tuple[Means, Covariances]:
    """Where the filters of a row start, each a group of its own (j = 1 in `Means`)."""
    log_w = jnp.log(transition) + log_p[:, None]
    w = jnp.exp(log_w - jax.nn.logsumexp(log_w, 0))
    n, x, own = means.x.shape[-1], means.x[:, 0], jnp.diagonal(w)
    middle = jnp.sum(w[:, :, None] * x[:, None], 0)
    apart = x[:, None] - middle
    spread = cov.P[:, None] + apart[..., :, None] * apart[..., None, :]
    Z = cov.Z[:, 0, :n]
    beyond = jnp.sum(Z[:, :, None] * Z[:, None], -1)
    # filter j's columns keep the share of j: its attacks stay correlated with its state
    share = w * (1.0 - jnp.diag(own))
    P = jnp.sum(w[..., None, None] * spread + share[..., None, None] * beyond[:, None], 0)
    kept = cov.Z.at[:, 0, :n].multiply(own[:, None, None])
    return Means(middle[:, None], means.d), Covariances(cov.open, P, kept)


def check_mixing(transition: object, freeze: float, width: int) -> None:
    """Raises `InvalidValue` where filters cannot be mixed; ``width``: modes in a group."""
    if transition is None:
        raise InvalidValue("mixing", "true without transition", "a transition to mix by")
    if freeze:
        raise InvalidValue("mixing", "true with freeze", "gains computed at every row, freeze = 0")
    if width > 1:
        raise InvalidValue("mixing", "true on a large plant", "one whose modes share no covariance")
