"""What a batch of rows leaves of a prior: gain, contributions by source, leverage, standardised residuals.

Written so that a kernel may compile it (`tasks/plane_kernels.py`); elsewhere it runs as it stands.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from estimation.transform import FloatArray

After = Callable[..., tuple[FloatArray, FloatArray, FloatArray, FloatArray]]


def after(
    root: FloatArray,
    prior: FloatArray,
    to_body: FloatArray,
    rows: FloatArray,
    variance: FloatArray,
    used: NDArray[np.bool_],
    contributions: FloatArray,
    noise: FloatArray,
    residual: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The posterior in Joseph form: error = (I - K H) B^-1 prior error - K noise.

    Parameters
    ----------
    root, prior : (n, n), (n,) the chart r0 = root z, and the weight of each z^2 in the cost.
    to_body : (n, n) B^-1, a change of r0 as a change of the state.
    rows, variance : H (m, n) by the state, Q (m,) m^2; those not `used` (m,) leave no trace in it.
    contributions, noise : (s, n, n) of the prior by source, (q, m) variances of the rows by source.
    residual : (m,) m.

    Returns the contributions that were there and those of the noise, leverage (m,), and residuals over their
    own standard deviations (m,), those of rows not used over that of the innovation. A flat freedom has no
    prior error, and I - K H is zero along it. Raises LinAlgError where an unknown is left open.
    """
    size = len(root)
    kept = rows[used]
    sigma = np.sqrt(variance[used])
    reach = to_body @ root
    whitened = (kept @ reach) / sigma.reshape(-1, 1)
    normal = whitened.T @ whitened + np.diag(prior)
    diagonal = np.diag(normal)
    if not (diagonal > 0.0).all():
        raise np.linalg.LinAlgError("an element of the diagonal is not positive")
    scale = 1.0 / np.sqrt(diagonal)  # whatever the units of the unknowns
    scaled = np.ascontiguousarray(scale.reshape(-1, 1) * whitened.T)
    # Not by an inverse: of rows that are far more precise than the prior it leaves nothing right.
    across = scale.reshape(-1, 1) * np.linalg.solve(normal * scale * scale.reshape(-1, 1), scaled)
    gain = (reach @ across) / sigma
    left = np.empty(contributions.shape)
    covariance = np.zeros((size, size))
    if len(contributions):
        remainder = (np.eye(size) - gain @ kept) @ to_body
        for i in range(len(contributions)):
            left[i] = remainder @ contributions[i] @ remainder.T
            covariance += left[i]
    added = np.empty((len(noise), size, size))
    for i in range(len(noise)):
        added[i] = (gain * noise[i][used]) @ gain.T
        covariance += added[i]
    # r = H d + noise, where d holds -K noise of the used rows; the same in joint and consider treatment.
    own_gain = np.zeros(len(variance))
    own_gain[used] = np.sum(kept * gain.T, axis=1)
    own = np.sum((rows @ covariance) * rows, axis=1)
    own += variance * np.where(used, 1.0 - 2.0 * own_gain, 1.0)
    known = own > 1e-9 * variance
    standardised = np.where(known, residual / np.sqrt(np.where(known, own, 1.0)), 0.0)
    return left, added, np.minimum(np.maximum(own_gain, 0.0), 1.0), standardised
