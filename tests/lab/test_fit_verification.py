"""The command that fits the verification, beside models of searches with and without true probabilities of cells."""

import torch

from semfov.observation.presence import Presence
from tests.refusals import refused
from tests.small import search_model
from train.fit_verification import FitVerificationConfig, _check_thresholds


def test_usual_thresholds_are_refused_for_cells_that_are_not_true():
    plain, true = (
        Presence(torch.tensor(0.0), torch.ones(2), torch.full((3,), 0.5), centre=centre)
        for centre in (None, torch.tensor([2.0, 0.9]))
    )
    model = search_model()
    model.presence = plain
    for settings in ({}, {"place": 0.05}, {"stop_below": 0.0005}):
        message = "place, stop_below: .* give --place 0.05 --stop_below 0.0005"
        refused(message, _check_thresholds, FitVerificationConfig(**settings), model)
    _check_thresholds(FitVerificationConfig(place=0.05, stop_below=0.0005), model)
    model.presence = true
    _check_thresholds(FitVerificationConfig(), model)
