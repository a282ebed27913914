"""Small networks, which predict from the hints of looks at windows."""

from torch import nn


def network(inputs: int, width: int, outputs: int = 1) -> nn.Sequential:
    """Make a network with two hidden layers of `width` units."""
    hidden = nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, width), nn.GELU()
    return nn.Sequential(*hidden, nn.Linear(width, outputs))
