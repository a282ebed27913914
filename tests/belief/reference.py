"""The networks of learned evidence and their inputs, in numpy and scipy."""

import numpy as np
import scipy.ndimage
import scipy.special


def array(tensor):
    return tensor.detach().cpu().double().numpy()


def run_network(network, inputs):
    """A network with an activation after every layer but the last, on the last axis of an array, in float64."""
    value = np.asarray(inputs, dtype=np.float64)
    for number, layer in enumerate(network):
        activated = number % 2
        value = value * scipy.special.ndtr(value) if activated else value @ array(layer.weight).T + array(layer.bias)
    return value[..., 0]


def log_scaled(odds):
    return np.log(odds + 1e-3) / 2 + 1


def blurred(values, columns, sigma):
    """Gaussian average over the cells `(X·Y,)`, cut off beyond three cells."""
    table = values.reshape(-1, columns)
    return scipy.ndimage.gaussian_filter(table, sigma, mode="constant", radius=3).ravel()


def local_maxima(values, columns):
    return scipy.ndimage.maximum_filter(values.reshape(-1, columns), 3, mode="nearest").ravel()


def readout_features(nearest, best, mean, distance, looks, prior, columns):
    """The 14 features of every cell after the looks, `(X·Y, 14)`."""
    cells, odds = len(nearest), scipy.special.expit(nearest)
    down, right = np.divmod(np.arange(cells), columns)
    rows = cells // columns
    y = 2 * down / (rows - 1) - 1 if rows > 1 else 0 * down
    x = 2 * right / (columns - 1) - 1 if columns > 1 else 0 * right
    each = [
        nearest / 2 + 1,
        best / 2 + 1,
        mean / 2 + 1,
        4 * distance,
        log_scaled(blurred(odds, columns, 0.6)),
        log_scaled(blurred(odds, columns, 1.5)),
        local_maxima(nearest, columns) / 2 + 1,
        nearest.max() / 2,
        best.max() / 2,
        log_scaled(odds.sum()),
        x**2 + y**2,
        y,
        np.log(looks) / 2,
        prior,
    ]
    return np.stack([np.broadcast_to(np.asarray(value, dtype=np.float64), (cells,)) for value in each], -1)
