"""Standard errors of means against values computed by hand."""

import numpy as np

from semfov.metrics.episodes import standard_error


def test_standard_error():
    values = np.array([[1.0, 2.0], [3.0, 2.0], [5.0, 2.0]])
    np.testing.assert_allclose(standard_error(values), [2 / np.sqrt(3), 0])
    assert np.isnan(standard_error(values[:1])).all()
    np.testing.assert_allclose(standard_error(values.T, axis=1), standard_error(values))
    assert standard_error(values[:, :1], axis=1).shape == (3,)
    # For a and b the standard deviation is |a - b| / √2, and the standard error of their mean |a - b| / 2.
    np.testing.assert_allclose(standard_error(np.array([[1.0, 2.0], [4.0, 2.0]])), [1.5, 0])
