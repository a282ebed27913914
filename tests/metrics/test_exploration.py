"""Metrics of explorations: the right answers for a cell, and when a belief is right about it."""

import torch

from semfov import Grid
from semfov.data import Annotation
from semfov.metrics.episodes import answers_of, right_cells


def test_a_cell_is_right_if_an_object_of_its_single_most_probable_class_overlaps_it():
    # Section IV-A: the "highest categorical score" must fit an overlapping object, and background has a score, too.
    answers = torch.tensor([[False, True, False]] * 4)
    beta = torch.tensor([[[0.2, 0.7, 0.1], [0.6, 0.3, 0.1], [0.1, 0.3, 0.6], [0.4, 0.35, 0.25]]])
    assert right_cells(beta, answers).sum(-1).tolist() == [1]
    # Without the background column, classes slightly less probable than background are right, too.
    assert right_cells(beta[..., 1:], answers[:, 1:]).sum(-1).tolist() == [3]
    answers = torch.tensor([[False, True], [False, True], [True, True]])
    beta = torch.tensor([[[0.5, 0.5], [0.5, 0.6], [0.6, 0.5]]])
    assert right_cells(beta, answers).sum(-1).tolist() == [2]


def test_answers_are_the_classes_of_overlapping_objects():
    annotation = Annotation(
        torch.tensor([[1.0, 1, 19, 19], [15, 5, 45, 15], [62, 42, 78, 58]]),
        torch.tensor([1, 2, 3]),
        torch.zeros(3, dtype=torch.bool),
        (80, 60),
    )
    answers = answers_of(annotation, Grid(4, 3, (80, 60)), 4)
    found = {cell: set(row.nonzero()[:, 0].tolist()) for cell, row in enumerate(answers) if row.any()}
    assert found == {0: {1, 2}, 1: {2}, 2: {2}, 11: {3}}
    # Also if the picture shows none of the last classes.
    annotation = Annotation(
        torch.tensor([[1.0, 1, 5, 5]]), torch.tensor([1]), torch.zeros(1, dtype=torch.bool), (20, 10)
    )
    answers = answers_of(annotation, Grid(2, 1, (20, 10)), 5)
    assert answers.tolist() == [[False, True, False, False, False], [False] * 5]
