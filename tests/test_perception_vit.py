"""Vision-transformer descriptors against transformers' own models and against slow, plain formulas."""

import hashlib
import json
import math
import shutil
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
import torch
import transformers
from safetensors.torch import load_file, save_file

from robust_instant_policy.cli import main
from robust_instant_policy.errors import InvalidValueError, ModelError
from robust_instant_policy.perception import PAPER_REAL, PAPER_SIMULATION, DescriptorSettings, KeypointExtractor
from robust_instant_policy.perception.descriptors import DescriptorMap
from robust_instant_policy.perception.vit import VitDescriptors
from robust_instant_policy.perception.vit_checkpoint import load_checkpoint
from tests.test_perception import scenes

FAMILY = {
    "vit": (
        transformers.ViTModel,
        transformers.ViTConfig,
        {"patch_size": 8, "image_size": 64, "num_attention_heads": 6, "intermediate_size": 96},
    ),
    "dinov2": (transformers.Dinov2Model, transformers.Dinov2Config, {"patch_size": 14, "image_size": 112}),
    "dinov2-swiglu": (
        transformers.Dinov2Model,
        transformers.Dinov2Config,
        {"patch_size": 14, "image_size": 112, "use_swiglu_ffn": True},
    ),
    "dinov2-registers": (
        transformers.Dinov2WithRegistersModel,
        transformers.Dinov2WithRegistersConfig,
        {"patch_size": 14, "image_size": 112, "layerscale_value": 0.7},
    ),
}


@pytest.fixture(scope="module", params=FAMILY)
def saved(request, tmp_path_factory):
    """A randomly initialised model of each family, and the folder it was saved to."""
    model_class, config_class, options = FAMILY[request.param]
    torch.manual_seed(0)
    config = config_class(
        hidden_size=48,
        num_hidden_layers=3,
        attn_implementation="eager",
        **{"num_attention_heads": 3, **options},
    )
    model = model_class(config).eval()
    with torch.no_grad():  # the usual start is so small that all patches look alike
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    folder = tmp_path_factory.mktemp(request.param)
    model.save_pretrained(folder)
    return model, folder


@pytest.fixture(scope="module")
def vit_folder(tmp_path_factory):
    torch.manual_seed(1)
    config = transformers.ViTConfig(
        hidden_size=48, num_hidden_layers=11, num_attention_heads=6, intermediate_size=64, patch_size=8, image_size=64
    )
    folder = tmp_path_factory.mktemp("vit")
    transformers.ViTModel(config).save_pretrained(folder)
    return folder


def test_tokens_and_saliency_are_those_of_transformers_own_model(saved):
    model, folder = saved
    checkpoint = load_checkpoint(str(folder))
    stride = model.config.patch_size
    side = model.config.image_size
    batch = torch.randn(1, 3, side, side)
    special = 1 + getattr(model.config, "num_register_tokens", 0)
    with torch.inference_mode():
        theirs = model(batch, output_hidden_states=True, output_attentions=True)
    for layer in range(3):
        expected = theirs.hidden_states[layer + 1][0, special:]
        ours = VitDescriptors(checkpoint, DescriptorSettings(side, stride, layer, "token"))
        found = ours.features(batch)[0].reshape(expected.shape)
        torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
    heads = [0, 2, 4, 5] if model.config.num_attention_heads == 6 else [0, 1, 2]
    attention = theirs.attentions[-1][0, heads, 0, special:].mean(dim=0)
    attention = (attention - attention.min()) / (attention.max() - attention.min())
    torch.testing.assert_close(ours.features(batch)[1].flatten(), attention, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("facet", ["query", "key", "value"])
@pytest.mark.parametrize("layer", [0, 2])
def test_facets_are_projections_of_the_normalised_tokens(vit_folder, facet, layer):
    weights = load_file(vit_folder / "model.safetensors")
    checkpoint = load_checkpoint(str(vit_folder))
    batch = torch.randn(1, 3, 64, 64)

    def features(layer: int, facet: str) -> torch.Tensor:
        return VitDescriptors(checkpoint, DescriptorSettings(64, 8, layer, facet)).features(batch)[0].reshape(64, 48)

    tokens = features(layer - 1, "token") if layer else checkpoint.model.embeddings(batch)[0, 1:]
    block = f"encoder.layer.{layer}"
    normed = torch.nn.functional.layer_norm(
        tokens, (48,), weights[f"{block}.layernorm_before.weight"], weights[f"{block}.layernorm_before.bias"], 1e-12
    )
    name = f"{block}.attention.attention.{facet}"
    expected = normed @ weights[f"{name}.weight"].T + weights[f"{name}.bias"]
    expected = expected.reshape(64, 6, 8).transpose(1, 2).reshape(64, 48)  # the reference keeps heads innermost
    torch.testing.assert_close(features(layer, facet), expected, atol=1e-5, rtol=1e-4)


def test_overlapping_patches_get_position_encodings_between_the_trained_ones(vit_folder):
    ours = VitDescriptors(load_checkpoint(str(vit_folder)), PAPER_SIMULATION)
    table = load_file(vit_folder / "model.safetensors")["embeddings.position_embeddings"]
    rows, cols = 21, 29
    dense = ours.positions(rows, cols)[0, 1:].reshape(rows, cols, 48)
    # Bicubic interpolation by DINO's own scale, (n + 0.1) / 8, written out for one place.
    square = table[0, 1:].reshape(8, 8, 48).double().numpy()

    def kernel(x: float) -> float:
        x = abs(x)
        if x <= 1:
            return 1.25 * x**3 - 2.25 * x**2 + 1
        return -0.75 * (x**3 - 5 * x**2 + 8 * x - 4) if x < 2 else 0.0

    y, x = (13 + 0.5) * 8 / (rows + 0.1) - 0.5, (6 + 0.5) * 8 / (cols + 0.1) - 0.5
    expected = np.zeros(48)
    for i in range(math.floor(y) - 1, math.floor(y) + 3):
        for j in range(math.floor(x) - 1, math.floor(x) + 3):
            expected += kernel(y - i) * kernel(x - j) * square[np.clip(i, 0, 7), np.clip(j, 0, 7)]
    np.testing.assert_allclose(dense[13, 6].numpy(), expected, atol=1e-5)


def slow_log_bins(features: np.ndarray) -> np.ndarray:
    """Log-binned descriptors ``(rows, cols, 17 D)``, patch by patch (Amir et al. 2022, Sec. 3)."""
    rows, cols, _ = features.shape
    pooled = np.zeros_like(features)
    for r in range(rows):
        for c in range(cols):
            pooled[r, c] = features[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2].mean(axis=(0, 1))
    result = []
    for r in range(rows):
        for c in range(cols):
            parts = []
            for level, reach in ((features, 1), (pooled, 3)):
                for i in (r - reach, r, r + reach):
                    for j in (c - reach, c, c + reach):
                        if reach == 1 or (i, j) != (r, c):
                            parts.append(level[min(max(i, 0), rows - 1), min(max(j, 0), cols - 1)])
            result.append(np.concatenate(parts))
    return np.array(result)


def random_map(seed: int, rows: int, cols: int) -> DescriptorMap:
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(rows, cols, 12)).astype(np.float32)
    return DescriptorMap(features, np.ones((rows, cols), np.float32), np.zeros(2), np.ones(2), log_bins=True)


def test_log_bins_equal_the_plain_formula():
    described = random_map(0, 9, 7)
    found = described.vectors(np.arange(63))
    np.testing.assert_allclose(found, slow_log_bins(described.features), atol=1e-5)
    assert described.vectors(np.arange(3)).shape == (3, 17 * 12)


def test_similarities_equal_the_cosine_of_the_written_out_descriptors():
    one, two = random_map(1, 8, 6), random_map(2, 5, 11)
    mine, its = np.array([0, 7, 30, 47]), np.arange(0, 55, 3)
    a, b = slow_log_bins(one.features)[mine], slow_log_bins(two.features)[its]
    expected = (a @ b.T) / np.linalg.norm(a, axis=1)[:, None] / np.linalg.norm(b, axis=1)
    np.testing.assert_allclose(one.similarities(mine, two, its), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "shape", "grid"), [(PAPER_SIMULATION, (100, 100), (47, 47)), (PAPER_REAL, (240, 320), (59, 79))]
)
def test_the_papers_settings_give_the_papers_grids(vit_folder, settings, shape, grid):
    described = VitDescriptors(load_checkpoint(str(vit_folder)), settings).describe(
        np.random.default_rng(0).integers(0, 255, (*shape, 3), dtype=np.uint8)
    )
    assert described.grid == grid
    np.testing.assert_allclose(described.origin, 3.5)
    last = described.origin + described.step * (np.array(grid[::-1]) - 1)
    np.testing.assert_allclose(last, np.array(shape[::-1]) - 4.5, atol=settings.stride)
    assert described.saliency.min() == 0
    assert described.saliency.max() == 1


def test_keypoints_come_from_a_folder_of_weights(vit_folder):
    settings = DescriptorSettings(load_size=100, stride=4)
    demonstrations = [scene.observation for scene in scenes(3, seed=0, turn=10)]
    extractor = KeypointExtractor(features=str(vit_folder), settings=settings).fit(demonstrations)
    assert extractor.descriptor_name_ == str(vit_folder)
    assert extractor.keypoints_.shape == (3, 10, 3)
    assert extractor.locate(demonstrations[0]).keypoints.shape == (10, 3)


def test_auto_takes_weights_that_are_named_in_the_environment(vit_folder, monkeypatch):
    monkeypatch.setenv("RIP_DINO_WEIGHTS", str(vit_folder))
    extractor = KeypointExtractor(settings=DescriptorSettings(load_size=100, stride=8))
    extractor.fit([scenes(1, seed=0)[0].observation])
    assert extractor.descriptor_name_ == str(vit_folder)
    assert "RIP_DINO_WEIGHTS" in extractor.notes_[0]


def test_a_lone_safetensors_file_is_enough(saved, tmp_path):
    _, folder = saved
    shutil.copy(folder / "model.safetensors", tmp_path / "weights.safetensors")
    alone = load_checkpoint(str(tmp_path / "weights.safetensors")).model
    whole = load_checkpoint(str(folder)).model
    assert alone.config.patch_size == whole.config.patch_size
    assert alone.config.image_size == whole.config.image_size
    for name, tensor in whole.state_dict().items():
        torch.testing.assert_close(alone.state_dict()[name], tensor)


def test_weights_spread_over_several_files_are_put_together(vit_folder, tmp_path):
    whole = load_checkpoint(str(vit_folder))
    model = transformers.ViTModel.from_pretrained(vit_folder)
    model.save_pretrained(tmp_path, max_shard_size="50KB")
    shards = sorted(tmp_path.glob("model-*.safetensors"))
    assert len(shards) > 1
    split = load_checkpoint(str(tmp_path))
    ours = split.model.state_dict()
    assert all(torch.equal(ours[name], tensor) for name, tensor in whole.model.state_dict().items())
    shards[0].unlink()
    with pytest.raises(ModelError, match=shards[0].name):
        load_checkpoint(str(tmp_path))


def test_a_checkpoint_that_does_not_fit_says_which_tensors(vit_folder, tmp_path):
    tensors = load_file(vit_folder / "model.safetensors")
    del tensors["encoder.layer.3.output.dense.bias"]
    tensors["encoder.layer.1.layernorm_before.weight"] = torch.ones(7)
    save_file(tensors, tmp_path / "model.safetensors")
    (tmp_path / "config.json").write_text((vit_folder / "config.json").read_text())
    with pytest.raises(ModelError, match=r"layers\.3\.mlp\.fc2\.bias is missing") as error:
        load_checkpoint(str(tmp_path))
    assert "layers.1.layernorm_before.weight is (7,) instead of (48,)" in str(error.value)
    assert "\n" not in str(error.value)
    pointer = tmp_path / "pointer.safetensors"
    pointer.write_text("version https://git-lfs.github.com/spec/v1\noid sha256:abc\nsize 1\n")
    with pytest.raises(ModelError, match="cannot be read as weights"):
        load_checkpoint(str(pointer))
    torch.save({"teacher": {"weight": torch.zeros(1)}, "epoch": 3}, tmp_path / "training.pth")
    with pytest.raises(ModelError, match=r"not a \.safetensors file"):
        load_checkpoint(str(tmp_path / "training.pth"))


def test_a_model_of_another_kind_is_refused_by_name(vit_folder, tmp_path):
    (tmp_path / "model.safetensors").write_bytes((vit_folder / "model.safetensors").read_bytes())
    config = json.loads((vit_folder / "config.json").read_text()) | {"model_type": "swin"}
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ModelError, match="'swin' model; supported: vit, dinov2, dinov2_with_registers"):
        load_checkpoint(str(tmp_path))


@pytest.mark.parametrize("source", ["/no/such/folder", "weights.safetensors", "a/b/c"])
def test_a_source_that_is_nowhere_is_told(source):
    with pytest.raises(ModelError, match=r"no image descriptors .*: known are auto, dino"):
        load_checkpoint(source)


def test_a_broken_file_is_told_in_one_line(tmp_path):
    (tmp_path / "model.safetensors").write_bytes(b"not weights at all")
    with pytest.raises(ModelError, match="cannot be read as weights") as error:
        load_checkpoint(str(tmp_path))
    assert "\n" not in str(error.value)


def test_weights_come_from_the_hub_and_then_from_its_cache(vit_folder, monkeypatch, tmp_path):
    commit, files = "c" * 40, {file.name: file.read_bytes() for file in vit_folder.iterdir()}

    class Hub(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            name = self.path.rsplit("/", 1)[1]
            if "/tree/" in self.path:
                body = json.dumps(
                    [{"type": "file", "path": file, "size": len(files[file]), "oid": "0" * 40} for file in files]
                ).encode()
            elif self.path.startswith("/api/"):
                siblings = [{"rfilename": file} for file in files]
                body = json.dumps({"id": "some/vit", "sha": commit, "siblings": siblings}).encode()
            else:
                body = files[name]
            self.send_response(200)
            self.send_header("ETag", f'"{hashlib.sha256(body).hexdigest()}"')
            self.send_header("X-Repo-Commit", commit)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command == "GET":
                self.wfile.write(body)

        do_HEAD = do_GET

        def log_message(self, *_: object) -> None: ...

    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), Hub) as server:
        address = f"http://127.0.0.1:{server.server_port}"
        monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", address)
        monkeypatch.setattr(
            "huggingface_hub.constants.HUGGINGFACE_CO_URL_TEMPLATE",
            address + "/{repo_id}/resolve/{revision}/{filename}",
        )
        threading.Thread(target=server.serve_forever, daemon=True).start()
        fetched = load_checkpoint("some/vit").model.state_dict()
        server.shutdown()
    cached = load_checkpoint("some/vit").model.state_dict()
    expected = load_checkpoint(str(vit_folder)).model.state_dict()
    assert all(
        torch.equal(fetched[name], tensor) and torch.equal(cached[name], tensor) for name, tensor in expected.items()
    )
    weights = next(tmp_path.rglob("model.safetensors"))
    (weights.parent / "README.md").symlink_to("nowhere")
    (weights.parent / "loop").symlink_to("loop")
    load_checkpoint("some/vit")
    (tmp_path / "models--some--vit").chmod(0o777)
    with pytest.raises(ModelError, match=r"other users can write to .*models--some--vit; run chmod -R go-w"):
        load_checkpoint("some/vit")
    (tmp_path / "models--some--vit").chmod(0o700)
    weights.resolve().chmod(0o666)
    with pytest.raises(ModelError, match=r"other users can write to .*; run chmod -R go-w"):
        load_checkpoint("some/vit")
    weights.resolve().chmod(0o600)
    weights.resolve().write_bytes(weights.read_bytes()[:-1] + b"\0")
    with pytest.raises(ModelError, match=r"model\.safetensors has another SHA-256 than the hub gave for it; remove"):
        load_checkpoint("some/vit")


def test_without_a_connection_the_hub_is_given_up_within_seconds(monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    start = time.monotonic()
    with pytest.raises(ModelError, match=r"facebook/dino-vits8 are not in the local cache and the hub cannot") as error:
        load_checkpoint("facebook/dino-vits8")
    assert time.monotonic() - start < 8
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("command", [["demo"], ["eval", "--tasks", "push-cube", "--methods", "rip", "--out", "rows"]])
def test_weights_that_cannot_be_had_are_told_before_anything_is_recorded(command, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr("huggingface_hub.constants.ENDPOINT", "http://127.0.0.1:9")
    monkeypatch.delenv("RIP_DINO_WEIGHTS", raising=False)
    monkeypatch.chdir(tmp_path)
    assert main([*command, "--config", "paper", "--llm", "embedded"]) == 1
    assert "facebook/dino-vits8 are not in the local cache" in capsys.readouterr().err
    assert not list(tmp_path.glob("data/*"))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (DescriptorSettings(64, stride=3), "stride 3 must divide the patch size 8"),
        (DescriptorSettings(64, stride=8, layer=11), "layer must be 0 to 10"),
        (DescriptorSettings(64, stride=8, facet="keys"), "facet must be one of key, query, value, token"),
    ],
)
def test_strides_layers_and_facets_that_do_not_exist_are_refused(vit_folder, settings, words):
    with pytest.raises(InvalidValueError, match=words):
        VitDescriptors(load_checkpoint(str(vit_folder)), settings)
