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


def class_odds(model, nearest, best, mean, distance, looks, targets, columns):
    """Log odds of T classes `(T, X·Y)`; each is read together with the strongest other class."""
    answer = []
    for row in range(len(nearest)):
        rival = np.delete(nearest, row, 0).max(0)
        features = readout_features(
            nearest[row], best[row], mean[row], distance, looks, float(model.prior[targets[row]].detach()), columns
        )
        answer.append(nearest[row] + run_network(model.read, np.concatenate([features, (rival / 2 + 1)[:, None]], -1)))
    return np.stack(answer)


def emptiness(model, odds, distance, looks, columns, stands_for=None):
    """Log odds that each cell holds nothing, `(X·Y,)`, from those of the classes `(T, X·Y)`."""
    share = np.ones(len(odds)) if stands_for is None else np.asarray(stands_for)
    none = (share[:, None] * scipy.special.log_expit(-odds)).sum(0)
    anything = 1 - np.exp(none)
    second, first = np.sort(odds, 0)[-2:]
    each = [
        none / 2,
        log_scaled(anything),
        first / 3,
        second / 3,
        log_scaled(blurred(anything, columns, 0.6)),
        log_scaled(blurred(anything, columns, 1.5)),
        log_scaled(anything.mean()),
        4 * distance,
        np.log(looks) / 2,
    ]
    features = np.stack([np.broadcast_to(value, none.shape) for value in each], -1)
    return none - np.log(np.maximum(anything, 1e-6)) + run_network(model.void, features)


def gain(model, probabilities, closest, looks, distance):
    """Expected gain of one look in each cell `(X·Y,)`, cell by cell."""
    answer = np.zeros(len(closest))
    for cell, (p, before, now) in enumerate(zip(probabilities, closest, distance, strict=True)):
        if now < before:
            second, first = np.sort(p[1:])[-2:]
            features = [
                *map(log_scaled, (first, second, p[0])),
                4 * before,
                4 * now,
                4 * (before - now),
                np.log(looks) / 2,
            ]
            answer[cell] = run_network(model.worth, features)
    return answer
