"""Acquisition functions, policies and saliency models as submodules of other modules."""

import torch
from torch import nn

from semfov import acquisition, policies, saliency
from semfov.belief import DirichletBelief
from semfov.belief.observers import LearnedMap
from semfov.gaze import IVSN, GazeHabits
from semfov.gaze.templates import ClassTemplates
from tests.base_tester import GraphTester, TensorTester
from tests.small import GRID, detections, look, mapping, memory, model, rand


class AcquisitionTester(GraphTester):
    """For functions of a belief and of the distance from each cell to the closest fixation."""

    batched = (0, 1)

    def inputs(self):
        return memory()

    @staticmethod
    def call(module, beta, closest):
        return module(DirichletBelief(beta, closest), closest == 0)


class TestTargetPosterior(AcquisitionTester):
    def make(self):
        return acquisition.TargetPosterior(2)


class TestPredictedTargetPosterior(AcquisitionTester):
    autocast = 0.05

    def make(self):
        return acquisition.PredictedTargetPosterior(2, model())


class TestNeighbourhoodPosterior(AcquisitionTester):
    def make(self):
        return acquisition.NeighbourhoodPosterior(2, model(), GRID)


class TestFovealHit(AcquisitionTester):
    def make(self):
        return acquisition.FovealHit(2, model(), GRID)


class TestPlaceInformation(AcquisitionTester):
    autocast = 0.05

    def make(self):
        return acquisition.PlaceInformation(2, model(), GRID)


class TestEntropyLimit(AcquisitionTester):
    def make(self):
        return acquisition.EntropyLimit(2, model(), GRID)


class TestSaliencyPrior(AcquisitionTester):
    def make(self):
        return acquisition.SaliencyPrior(acquisition.TargetPosterior(2), rand(len(GRID)), weight=0.5)


class TestTemplateAttention(AcquisitionTester):
    def make(self):
        return acquisition.TemplateAttention(2, rand(len(GRID), 3, len(GRID)), GRID)


class TestObjectEvidence(AcquisitionTester):
    def make(self):
        return acquisition.ObjectEvidence()


class TestCloserLook(AcquisitionTester):
    def make(self):
        return acquisition.CloserLook(GRID)


class TestStatic(AcquisitionTester):
    def make(self):
        return acquisition.Static(rand(len(GRID)))


class TestUniform(AcquisitionTester):
    def make(self):
        return acquisition.Uniform()


class LookAheadTester(AcquisitionTester):
    """For functions that subtract nearly equal values."""

    autocast = 0.1


class TestKLDivergence(LookAheadTester):
    def make(self):
        return acquisition.KLDivergence(model(), GRID)


class TestBayesianSurprise(LookAheadTester):
    def make(self):
        return acquisition.BayesianSurprise(model(), GRID)


class TestNegativeEntropy(LookAheadTester):
    def make(self):
        return acquisition.NegativeEntropy(model(), GRID)


class TestTwoPeaks(LookAheadTester):
    def make(self):
        return acquisition.TwoPeaks(model(), GRID)


class TestUpperConfidenceBound(LookAheadTester):
    def make(self):
        return acquisition.UpperConfidenceBound(model(), GRID)


class TestProbabilityOfImprovement(LookAheadTester):
    def make(self):
        return acquisition.ProbabilityOfImprovement(model(), GRID)


class TestExpectedAccuracy(LookAheadTester):
    def make(self):
        return acquisition.ExpectedAccuracy(model(), GRID)


class TestCorrectLocalisation(AcquisitionTester, TensorTester):
    def make(self):
        return acquisition.CorrectLocalisation(2, model(), GRID, nodes=8)


class TestExpectedGain(GraphTester):
    """After one look."""

    batched = (0, 1, 2)

    def make(self):
        return acquisition.ExpectedGain(mapping(), GRID)

    def inputs(self):
        return look()

    @staticmethod
    def call(module, scores, boxes, fixation):
        mapper = LearnedMap(module.model)
        belief = mapper(mapper.start(len(scores), GRID, scores), detections(scores, boxes), fixation, GRID)
        return module(belief, belief.visited)


class PolicyTester(AcquisitionTester):
    """Values that a policy's acquisition function gives for a belief; that function has the other tests."""

    test_shapes = test_no_rows = test_dtypes = test_autocast = test_gradcheck = test_vmap = None
    test_compile = test_export = None

    @staticmethod
    def call(module, beta, closest):
        return module(2, GRID)(DirichletBelief(beta, closest), closest == 0)


class TestRandom(PolicyTester):
    def make(self):
        return policies.Random()


class TestNonPredictive(PolicyTester):
    def make(self):
        return policies.NonPredictive()


class TestPredictive(PolicyTester):
    def make(self):
        return policies.Predictive(model())


class TestNeighbourhood(PolicyTester):
    def make(self):
        return policies.Neighbourhood(model())


class TestFovealHits(PolicyTester):
    def make(self):
        return policies.FovealHits(model())


class TestInformationOnPlace(PolicyTester):
    def make(self):
        return policies.InformationOnPlace(model())


class TestEntropyLimitMinimisation(PolicyTester):
    def make(self):
        return policies.EntropyLimitMinimisation(model().requires_grad_(False))


class TestIdealObserver(TensorTester):
    batched = (0, 1)
    inputs = PolicyTester.inputs
    call = staticmethod(PolicyTester.call)

    def make(self):
        return policies.IdealObserver(model())


class TableTester(PolicyTester):
    """For policies that need a table of every scene, seen from the fixated cell."""

    @staticmethod
    def call(module, beta, closest):
        table = rand(12, 12) if module.table == "saliency" else rand(12, 3, 12)
        return module.in_scene(2, GRID, table, torch.tensor([3, 5]))(DirichletBelief(beta, closest), closest == 0)


class TestSaliencyMaximum(TableTester):
    def make(self):
        return policies.SaliencyMaximum()


class TestTemplateSearch(TableTester):
    def make(self):
        return policies.TemplateSearch()


class TestCloser(PolicyTester):
    def make(self):
        return policies.Closer()


class TestObjectSeeking(PolicyTester):
    def make(self):
        return policies.ObjectSeeking()


class TestKL(PolicyTester):
    def make(self):
        return policies.KL(model())


class TestSurprise(PolicyTester):
    def make(self):
        return policies.Surprise(model())


class TestNegentropy(PolicyTester):
    def make(self):
        return policies.Negentropy(model())


class TestPeaks(PolicyTester):
    def make(self):
        return policies.Peaks(model())


class TestConfidenceBound(PolicyTester):
    def make(self):
        return policies.ConfidenceBound(model())


class TestImprovement(PolicyTester):
    def make(self):
        return policies.Improvement(model())


class TestAccuracy(PolicyTester):
    def make(self):
        return policies.Accuracy(model().requires_grad_(False))


class TestGain(TestExpectedGain):
    def make(self):
        return policies.Gain(mapping())

    @staticmethod
    def call(module, scores, boxes, fixation):
        return TestExpectedGain.call(module(None, GRID), scores, boxes, fixation)


class TestGazeHabits(TensorTester):
    """Log probabilities of the next cell, given the present one."""

    batched = (0, 1, 2)

    def make(self):
        return GazeHabits(0.5, rand(len(GRID)), rand(3), [0.2, 0.5], rand(2), [2.0], 4)

    def inputs(self):
        return rand(2, len(GRID)), torch.tensor([1, 7]), torch.full((2, len(GRID)), torch.inf)

    @staticmethod
    def call(module, values, cell, age):
        return module(values, cell, age, GRID)


class TestIVSN(TensorTester):
    batched = (0, 1)

    def make(self):
        return IVSN(nn.Conv2d(3, 4, 3, 2, 1), nn.AdaptiveMaxPool2d(1), picture=32, target=8)

    def inputs(self):
        return rand(2, 3, 48, 64), rand(2, 3, 12, 9)


class TestClassTemplates(GraphTester):
    def make(self):
        return ClassTemplates(rand(3, 5), rand(5), ("cat", "cup", "person"))

    def inputs(self):
        return (rand(2, 5, 4, 6),)


class TestVOCUS2(GraphTester):
    autocast = 0.05

    def make(self):
        return saliency.VOCUS2()

    def inputs(self):
        return (rand(2, 3, 40, 60),)


class TestIttiKoch(GraphTester):
    def make(self):
        return saliency.IttiKoch()

    def inputs(self):
        return (rand(2, 3, 64, 96),)
