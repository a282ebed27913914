"""Acquisition functions, policies and saliency models as submodules of other modules."""

import pytest
import torch

from semfov import DirichletBelief, acquisition, policies, saliency
from tests.base_tester import GraphTester, TensorTester, make_testers
from tests.small import GRID, memory, model, rand


class AcquisitionTester(GraphTester):
    """For functions of a belief and of the distance from each cell to the closest fixation."""

    batched = (0, 1)
    autocast = 0.0

    def inputs(self):
        return memory()

    @staticmethod
    def call(module, beta, closest):
        return module(DirichletBelief(beta, closest), closest == 0)


def functions(target, model, values):
    """Acquisition functions on `GRID` by name: for a target, a function that makes an observation model, and values."""
    a = acquisition
    return {
        "TargetPosterior": lambda: a.TargetPosterior(target),
        "PredictedTargetPosterior": lambda: a.PredictedTargetPosterior(target, model()),
        "NeighbourhoodPosterior": lambda: a.NeighbourhoodPosterior(target, model(), GRID),
        "FovealHit": lambda: a.FovealHit(target, model(), GRID),
        "PlaceInformation": lambda: a.PlaceInformation(target, model(), GRID),
        "KLDivergence": lambda: a.KLDivergence(model(), GRID),
        "BayesianSurprise": lambda: a.BayesianSurprise(model(), GRID),
        "NegativeEntropy": lambda: a.NegativeEntropy(model(), GRID),
        "TwoPeaks": lambda: a.TwoPeaks(model(), GRID),
        "UpperConfidenceBound": lambda: a.UpperConfidenceBound(model(), GRID),
        "ProbabilityOfImprovement": lambda: a.ProbabilityOfImprovement(model(), GRID),
        "ExpectedAccuracy": lambda: a.ExpectedAccuracy(model(), GRID),
        "ExpectedGain": lambda: a.ExpectedGain(GRID),
        "CloserLook": lambda: a.CloserLook(GRID),
        "Static": lambda: a.Static(values),
        "Uniform": a.Uniform,
        "SaliencyPrior": lambda: a.SaliencyPrior(a.TargetPosterior(target), values, weight=0.5),
    }


for name, make in functions(2, model, rand(len(GRID))).items():
    globals().update(make_testers(AcquisitionTester, {name: make}))
globals().update(make_testers(AcquisitionTester, {"EntropyLimit": lambda: acquisition.EntropyLimit(2, model(), GRID)}))


class TestCorrectLocalisation(AcquisitionTester, TensorTester):
    def make(self):
        return acquisition.CorrectLocalisation(2, model(), GRID, nodes=8)


class PolicyTester(AcquisitionTester):
    """Values that a policy's acquisition function gives for a belief; that function has the other tests."""

    test_shapes = test_no_rows = test_dtypes = test_autocast = test_gradcheck = test_vmap = None
    test_export = None

    @staticmethod
    def call(module, beta, closest):
        return module(2, GRID)(DirichletBelief(beta, closest), closest == 0)


class TestPolicyCorrectLocalisation(TensorTester):
    batched = (0, 1)
    inputs = PolicyTester.inputs
    call = staticmethod(PolicyTester.call)

    def make(self):
        return policies.Policy("ideal-observer", model())


for kind in (each for each in acquisition.FUNCTIONS.values() if each.__module__.startswith("semfov.")):
    if kind not in (acquisition.CorrectLocalisation, acquisition.Static):
        made = {f"Policy{kind.__name__}": lambda kind=kind: policies.Policy(kind, model().requires_grad_(False))}
        globals().update(make_testers(PolicyTester, made))


globals().update(make_testers(PolicyTester, {"Policy": lambda: policies.Policy("saliency", values=rand(len(GRID)))}))


class TestFixationDensity(GraphTester):
    """After scanpaths of three fixations, on the cells of the picture."""

    batched = (0, 1, 2)
    differentiable = (0, 1, 2)

    def make(self):
        density = saliency.FixationDensity({"fine": 3, "coarse": 2}, readouts=2, units=4, centre=-rand(3, 4))
        with torch.no_grad():
            for parameter in density.oculomotor.parameters():
                parameter.add_(0.2 * torch.randn_like(parameter))
        return density

    def inputs(self):
        return rand(2, 3, 6, 8), rand(2, 2, 3, 4), 60 * rand(2, 3, 2)

    @staticmethod
    def call(module, fine, coarse, scanpath):
        return module({"fine": fine, "coarse": coarse}, (39, 52), scanpath).flatten(1)[:, ::97]


class TestPictureLikeness(GraphTester):
    """Fitted to correlated values."""

    batched = (0,)
    differentiable = (0,)

    def make(self):
        values = torch.randn(60, 5, generator=torch.Generator().manual_seed(0))
        return saliency.PictureLikeness.fitted(values @ values[:5], axes=2)

    def inputs(self):
        return (rand(4, 5),)


class TestOculomotorBias(GraphTester):
    batched = (0,)
    differentiable = (0, 1)
    autocast = 0.0

    def make(self):
        bias = saliency.OculomotorBias()
        with torch.no_grad():
            for parameter in bias.parameters():
                parameter.add_(torch.randn_like(parameter))
        return bias

    def inputs(self):
        return rand(2, 4, 2), rand(5, 2)


class SaliencyTester(GraphTester):
    """Tests of a model with which studies compare: its graph is long to trace."""

    @pytest.mark.lab
    def test_export(self):
        super().test_export()


class TestVOCUS2(SaliencyTester):
    autocast = 0.05

    def make(self):
        return saliency.VOCUS2(layers=2)

    def inputs(self):
        return (rand(2, 3, 40, 60),)


class TestIttiKoch(SaliencyTester):
    def make(self):
        return saliency.IttiKoch()

    def inputs(self):
        return (rand(2, 3, 64, 96),)
