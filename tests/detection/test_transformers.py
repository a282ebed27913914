"""The detectors of transformers: small random models against transformers' own post-processing."""

import json
import sys

import pytest
import torch
import transformers as hf
from torch import nn
from transformers.models.hgnet_v2 import HGNetV2Config

from semfov import InputError, load_detector
from semfov.detection.transformers import _SOFTMAX
from tests.refusals import refused, unusable

PROCESSORS = {
    "detr": hf.DetrImageProcessor,
    "table-transformer": hf.DetrImageProcessor,
    "yolos": hf.YolosImageProcessor,
    "conditional_detr": hf.ConditionalDetrImageProcessor,
    "dab-detr": hf.ConditionalDetrImageProcessor,
    "deformable_detr": hf.DeformableDetrImageProcessor,
}
"""Whose `post_process_object_detection` a kind of model uses, if it is not RT-DETR's."""

NAMES = {0: "N/A", 1: "cat", 2: "dog", 3: "cup"}
SMALL = {"d_model": 16, "encoder_attention_heads": 2, "decoder_attention_heads": 2, "decoder_ffn_dim": 32}
HYBRID = {
    **SMALL,
    "num_labels": 4,
    "id2label": NAMES,
    "encoder_hidden_dim": 16,
    "encoder_ffn_dim": 32,
    "encoder_in_channels": [16, 24, 32],
    "feat_strides": [8, 16, 32],
    "decoder_in_channels": [16, 16, 16],
    "decoder_layers": 2,
    "num_queries": 20,
    "num_denoising": 0,
}


def resnet():
    return hf.RTDetrResNetConfig(
        embedding_size=8,
        hidden_sizes=[8, 16, 24, 32],
        depths=[1, 1, 1, 1],
        layer_type="basic",
        out_features=["stage2", "stage3", "stage4"],
    )


def hgnet():
    return HGNetV2Config(
        hidden_sizes=[8, 16, 24, 32],
        stem_channels=[3, 8, 8],
        stage_in_channels=[8, 8, 16, 24],
        stage_mid_channels=[8, 8, 8, 8],
        stage_out_channels=[8, 16, 24, 32],
        stage_num_blocks=[1, 1, 1, 1],
        stage_downsample=[False, True, True, True],
        stage_light_block=[False, False, True, True],
        stage_kernel_size=[3, 3, 5, 5],
        stage_numb_of_layers=[1, 1, 1, 1],
        out_features=["stage2", "stage3", "stage4"],
    )


def like_detr(config, model, stages=("stage4",), **more):
    """A model of the family of DETR, with one layer each in its encoder and its decoder."""
    backbone = hf.ResNetConfig(
        embedding_size=8, hidden_sizes=[8, 16, 24, 32], depths=[1, 1, 1, 1], layer_type="basic", out_features=[*stages]
    )
    sizes = {"encoder_layers": 1, "decoder_layers": 1, "encoder_ffn_dim": 32, "num_queries": 12, "id2label": NAMES}
    settings = {**SMALL, **sizes, **more}
    return model(config(**settings, use_timm_backbone=False, backbone_config=backbone, backbone=None))


def yolos():
    sizes = {"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "intermediate_size": 32}
    config = hf.YolosConfig(
        **sizes, image_size=[96, 128], num_detection_tokens=12, use_mid_position_embeddings=False, id2label=NAMES
    )
    return hf.YolosForObjectDetection(config)


MODELS = {
    "detr": lambda: like_detr(hf.DetrConfig, hf.DetrForObjectDetection),
    "table-transformer": lambda: like_detr(hf.TableTransformerConfig, hf.TableTransformerForObjectDetection),
    "yolos": yolos,
    "conditional_detr": lambda: like_detr(hf.ConditionalDetrConfig, hf.ConditionalDetrForObjectDetection),
    "dab-detr": lambda: like_detr(hf.DabDetrConfig, hf.DabDetrForObjectDetection, hidden_size=16),
    "deformable_detr": lambda: like_detr(
        hf.DeformableDetrConfig,
        hf.DeformableDetrForObjectDetection,
        ("stage2", "stage3", "stage4"),
        d_model=32,
        decoder_layers=2,
    ),
    "rt_detr": lambda: hf.RTDetrForObjectDetection(hf.RTDetrConfig(backbone_config=resnet(), **HYBRID)),
    "rt_detr_v2": lambda: hf.RTDetrV2ForObjectDetection(hf.RTDetrV2Config(backbone_config=resnet(), **HYBRID)),
    "d_fine": lambda: hf.DFineForObjectDetection(hf.DFineConfig(backbone_config=hgnet(), **HYBRID)),
}


def small(kind):
    """A random model whose boxes and scores depend on the picture, and are not all alike."""
    torch.manual_seed(0)
    model = MODELS[kind]().eval()
    for layer in model.modules():
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight)
        elif isinstance(layer, nn.BatchNorm2d):
            nn.init.ones_(layer.weight)
    for name, parameter in model.named_parameters():
        if any(part in name for part in ("class", "bbox", "score")):
            nn.init.normal_(parameter, std=0.3)
    return model


@pytest.mark.slow
@pytest.mark.parametrize("kind", MODELS)
def test_boxes_and_scores_are_those_of_transformers(kind):
    """Of each box transformers returns one class, and its score; RT-DETR's top-k may return a box several times."""
    model = small(kind)
    detector = load_detector(model, processor={"size": {"height": 96, "width": 128}}, threshold=0.0, iou=1.0)
    assert (detector.name, detector.classes) == (kind, ("cat", "dog", "cup"))
    assert detector.background == ("own" if kind in _SOFTMAX else "residual")
    canvas, _ = detector.fit(torch.rand(2, 3, 60, 80))
    assert canvas.shape == (2, 3, 96, 128)
    found = detector.propose(canvas)
    with torch.no_grad():
        outputs = model(pixel_values=detector.preprocessing(canvas))
    processor = PROCESSORS.get(kind, hf.RTDetrImageProcessor)()
    theirs = processor.post_process_object_detection(outputs, threshold=0.0, target_sizes=[(96, 128)] * 2)
    for image, each in enumerate(theirs):
        compared = 0
        for box, label, score in zip(each["boxes"], each["labels"], each["scores"], strict=True):
            row = (found.boxes[image] - box).abs().amax(-1).argmin()
            torch.testing.assert_close(found.boxes[image, row], box, atol=1e-3, rtol=1e-4)
            if int(label) > 0:  # "N/A" is left out
                torch.testing.assert_close(found.classes[image, row, int(label) - 1], score)
                compared += 1
        assert compared
    if kind in _SOFTMAX:
        softmax = outputs.logits.softmax(-1)
        torch.testing.assert_close(found.background, softmax[..., -1])
    detections = detector(torch.rand(1, 3, 60, 80))
    torch.testing.assert_close(detections.scores.sum(-1), torch.ones(detections.scores.shape[:-1]))
    assert detections.boxes[..., 2].max() <= 80


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["detr", "rt_detr"])
def test_gradients_reach_the_picture(kind):
    detector = load_detector(small(kind), processor={"size": {"height": 64, "width": 64}})
    image = torch.rand(1, 3, 64, 64, requires_grad=True)
    detector(image).scores[..., 1:].sum().backward()
    assert image.grad is not None
    assert image.grad.abs().sum() > 0


class Outputs(nn.Module):
    """What an export to ONNX keeps."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, image):
        outputs = self.model(pixel_values=image)
        return outputs.logits, outputs.pred_boxes


# Of each way in which scores and canvases are read one; onnxruntime does not sample at points of float64, as the graph
# of Deformable DETR does.
EXPORTED = [
    kind if kind in ("detr", "conditional_detr", "rt_detr") else pytest.param(kind, marks=pytest.mark.long)
    for kind in MODELS
    if kind != "deformable_detr"
]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", EXPORTED)
def test_exported_models_give_the_same_candidates(kind, tmp_path):
    model, canvas = small(kind), torch.rand(1, 3, 96, 128)
    names = {"input_names": ["pixel_values"], "output_names": ["logits", "pred_boxes"]}
    with torch.no_grad():
        torch.onnx.export(Outputs(model), (canvas,), tmp_path / "model.onnx", dynamo=False, **names)
    if kind in PROCESSORS and kind not in _SOFTMAX:  # ONNX models with sigmoids are taken for RT-DETR's
        means = {"mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)}
        (tmp_path / "model.json").write_text(json.dumps({"preprocessing": means}))
    exported = load_detector(tmp_path / "model.onnx", classes=[*NAMES.values()])
    detector = load_detector(model, processor={"size": {"height": 96, "width": 128}})
    assert exported.background == detector.background
    found, wanted = exported.propose(canvas), detector.propose(canvas)
    assert (wanted.classes - detector.propose(canvas.flip(-1)).classes).abs().max() > 1e-3
    torch.testing.assert_close(found.boxes, wanted.boxes, atol=1e-2, rtol=1e-3)
    torch.testing.assert_close(found.classes, wanted.classes, atol=1e-4, rtol=1e-3)


def test_pictures_are_resized_as_by_the_image_processor():
    detector = load_detector(small("detr"))
    image = torch.rand(1, 3, 100, 300)
    theirs = hf.DetrImageProcessor()(image[0], do_rescale=False, return_tensors="pt", do_pad=False)["pixel_values"]
    canvas, placement = detector.fit(image)
    assert canvas.shape == theirs.shape
    torch.testing.assert_close(detector.preprocessing(canvas), theirs, atol=0.05, rtol=0)
    torch.testing.assert_close(
        placement.boxes_to_image(torch.tensor([[0.0, 0.0, canvas.shape[-1], canvas.shape[-2]]])),
        torch.tensor([[0.0, 0.0, 300.0, 100.0]]),
    )


@pytest.mark.parametrize(
    ("settings", "shape"),
    [
        ({"size": {"max_height": 60, "max_width": 90}}, (30, 90)),
        ({"size": {"shortest_edge": 64, "longest_edge": 120}}, (40, 120)),
        ({"size": {"shortest_edge": 50}}, (50, 150)),
        ({"size": {"longest_edge": 60, "shortest_edge": None}}, (20, 60)),
        ({"size": 64, "max_size": 120}, (40, 120)),
        ({"size": [64, 96]}, (64, 96)),
        ({"do_resize": False}, (100, 300)),
        ({"do_resize": False, "size": {"height": 64, "width": 64}}, (100, 300)),
    ],
)
def test_sizes_of_image_processors_are_understood(settings, shape):
    detector = load_detector(small("detr"), processor=settings)
    canvas, placement = detector.fit(torch.rand(1, 3, 100, 300))
    assert canvas.shape[-2:] == shape
    json.dumps(detector.settings(), allow_nan=False)
    corner = torch.tensor([[0.0, 0.0, shape[1], shape[0]]])
    torch.testing.assert_close(placement.boxes_to_image(corner), torch.tensor([[0.0, 0.0, 300.0, 100.0]]))
    if set(settings) == {"size"} and isinstance(settings["size"], dict) and len(settings["size"]) == 2:
        sizes = {key: value for key, value in settings["size"].items() if value is not None}
        if len(sizes) == 2:
            theirs = hf.DetrImageProcessor(size=sizes, do_pad=False)(torch.rand(3, 100, 300), do_rescale=False)
            assert theirs["pixel_values"][0].shape[-2:] == shape


@pytest.mark.parametrize(("settings", "factor"), [({"do_rescale": False}, 255), ({"rescale_factor": 1 / 127.5}, 2)])
def test_pixels_are_scaled_as_by_the_image_processor(settings, factor):
    settings = {"do_normalize": False, "size": {"height": 64, "width": 64}, **settings}
    detector = load_detector(small("detr"), processor=settings)
    picture = torch.randint(0, 256, (3, 64, 64), dtype=torch.uint8)
    canvas, _ = detector.fit(picture[None] / 255)
    theirs = hf.DetrImageProcessor(**settings, do_pad=False)(picture, return_tensors="pt")["pixel_values"]
    torch.testing.assert_close(detector.preprocessing(canvas), theirs.float(), atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(detector.preprocessing(canvas), canvas * factor)


def test_settings_that_would_be_ignored_are_refused():
    for size in ({"height": 64}, {"width": 0, "height": 64}, "large", {"shortest_edge": 1e9}, [640], 0, True):
        with pytest.raises(InputError, match="processor size: expected height and width, max_height"):
            load_detector(small("detr"), processor={"size": size})
    model = small("rt_detr")
    model.config.use_focal_loss = False
    refused("model: expected scores trained with focal loss, got use_focal_loss=False", load_detector, model)


@pytest.mark.slow
def test_a_saved_model_is_loaded_with_its_processor(tmp_path):
    model = small("rt_detr")
    model.save_pretrained(tmp_path)
    hf.RTDetrImageProcessor(size={"height": 64, "width": 96}).save_pretrained(tmp_path)
    detector = load_detector(f"hf:{tmp_path}", limit=5)
    assert (detector.input_size, detector.selection.limit) == ((96, 64), 5)
    image = torch.rand(1, 3, 40, 60)
    other = load_detector(model, processor={"size": {"height": 64, "width": 96}}, limit=5)
    torch.testing.assert_close(detector(image).scores, other(image).scores)
    assert detector.digest == other.digest
    json.dumps(detector.settings())


def test_models_that_cannot_be_read_are_refused(tmp_path, monkeypatch):
    unusable("cannot load 'hf:", load_detector, f"hf:{tmp_path}")
    refused("detector: expected hf:owner/name, got 'hf:'", load_detector, "hf:")
    small_text = {"hidden_size": 8, "intermediate_size": 8, "num_hidden_layers": 1, "num_attention_heads": 1}
    config = hf.OwlViTConfig(text_config=small_text, vision_config=small_text, projection_dim=8)
    refused(r"classes of its own, such as RTDetr.*got OwlViT", load_detector, hf.OwlViTForObjectDetection(config))
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused("pip install transformers", load_detector, "hf:someone/model")
