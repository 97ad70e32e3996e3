"""Objects that ManiSkill downloads: with models in the downloads' own layout, and without any.

The real downloads are not there at CI; these models are made here, in the same folders, formats and conventions.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mani_skill import ASSET_DIR, PACKAGE_ASSET_DIR
from mani_skill.utils.building.actors import ycb

from robust_instant_policy.errors import RipError, UnknownNameError
from robust_instant_policy.tasks import make_task
from robust_instant_policy.tasks.banana import Banana
from robust_instant_policy.tasks.maniskill import partnet
from robust_instant_policy.trajectory import downsample

TASKS = ("pick-banana", "open-drawer", "close-cabinet", "turn-faucet")


@pytest.fixture
def downloaded_to(monkeypatch):
    """Lets the downloads lie in a folder: ManiSkill reads MS_ASSET_DIR when it is imported only."""

    def use(folder: Path) -> None:
        monkeypatch.setattr(ycb, "ASSET_DIR", folder / "data")
        for name in ("YCB_FOLDER", "PARTNET_FOLDER"):
            place = getattr(partnet, name).relative_to(ASSET_DIR)
            monkeypatch.setattr(partnet, name, folder / "data" / place)

    return use


class _Partnet:
    """A PartNet-Mobility model: boxes with y up, the front towards +z, in a unit sphere."""

    def __init__(self, folder: Path, model: int):
        self.folder = folder / "partnet_mobility" / "dataset" / str(model)
        self.folder.mkdir(parents=True)
        self.links: dict[str, str] = {"body": ""}
        self.joints = '<joint name="root" type="fixed"><parent link="base"/><child link="body"/>'
        self.joints += '<origin xyz="0 0 0" rpy="1.5707963 0 -1.5707963"/></joint>'

    def box(self, link: str, low: tuple[float, ...], high: tuple[float, ...], name: str = "board") -> None:
        low_, high_ = np.array(low), np.array(high)
        mesh = trimesh.creation.box(high_ - low_, trimesh.transformations.translation_matrix((low_ + high_) / 2))
        file = f"{link}-{len(self.links[link])}.obj"
        mesh.export(self.folder / file)
        self.links[link] += f'<visual name="{name}"><geometry><mesh filename="{file}"/></geometry></visual>'
        self.links[link] += f'<collision><geometry><mesh filename="{file}"/></geometry></collision>'

    def joint(self, link: str, kind: str, at: str, axis: str, upper: float) -> None:
        self.links[link] = ""
        self.joints += f'<joint name="joint_{link}" type="{kind}"><parent link="body"/><child link="{link}"/>'
        self.joints += f'<origin xyz="{at}"/><axis xyz="{axis}"/><limit lower="0" upper="{upper}"/></joint>'

    def write(self) -> None:
        links = "".join(f'<link name="{name}">{shapes}</link>' for name, shapes in self.links.items())
        text = f'<robot name="model"><link name="base"/>{links}{self.joints}</robot>'
        (self.folder / "mobility_cvx.urdf").write_text(text)

    def carcass(self) -> None:
        for low, high in (
            ((-0.6, -0.4, -0.5), (0.6, -0.34, 0.5)),
            ((-0.6, 0.34, -0.5), (0.6, 0.4, 0.5)),
            ((-0.6, -0.34, -0.5), (-0.54, 0.34, 0.5)),
            ((0.54, -0.34, -0.5), (0.6, 0.34, 0.5)),
            ((-0.54, -0.34, -0.5), (0.54, 0.34, -0.44)),
        ):
            self.box("body", low, high)


@pytest.fixture(scope="module")
def downloads(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("maniskill")
    folder = home / "data"  # where ManiSkill puts downloads under MS_ASSET_DIR
    info = "info_cabinet_drawer_train.json", "info_cabinet_door_train.json", "info_faucet_train.json"
    drawers, doors, faucets = (
        json.loads((PACKAGE_ASSET_DIR / "partnet_mobility" / "meta" / name).read_text()) for name in info
    )
    chest = _Partnet(folder, next(model for model in drawers if model not in doors))
    chest.carcass()
    chest.joint("drawer", "prismatic", "0 0 0.5", "0 0 1", 0.6)
    chest.box("drawer", (-0.52, -0.05, -0.6), (0.52, 0.32, 0.06))
    chest.box("drawer", (-0.06, 0.1, 0.06), (0.06, 0.25, 0.28), "handle-1")
    chest.write()
    cabinet = _Partnet(folder, next(model for model in doors if model not in drawers))
    cabinet.carcass()
    cabinet.joint("door", "revolute", "-0.58 0 0.51", "0 -1 0", 2.0)
    cabinet.box("door", (0.0, -0.38, 0.0), (1.16, 0.38, 0.07))
    cabinet.write()
    faucet = _Partnet(folder, next(iter(faucets)))
    faucet.box("body", (-0.1, -0.45, -0.1), (0.1, 0.05, 0.1))
    faucet.box("body", (-0.06, -0.15, 0.1), (0.06, -0.05, 0.5))
    faucet.joint("lever", "revolute", "0 0.1 0", "0 1 0", 1.5)
    faucet.box("lever", (-0.05, -0.03, -0.05), (0.45, 0.03, 0.05))
    faucet.write()

    objects = folder / "assets" / "mani_skill2_ycb"
    banana = objects / "models" / "011_banana"
    banana.mkdir(parents=True)
    vertices, faces, _, _ = Banana.draw(np.random.default_rng(0)).mesh()
    turned = trimesh.Trimesh(vertices, faces).apply_transform(trimesh.transformations.rotation_matrix(1.0, (0, 0, 1)))
    turned.apply_translation((0.03, -0.02, 0.01)).export(banana / "textured.obj")
    box = {"min": turned.bounds[0].tolist(), "max": turned.bounds[1].tolist()}
    points = np.asarray(turned.vertices)
    along = (points - points.mean(axis=0)) @ (np.cos(1.0), np.sin(1.0), 0.0)
    pieces = [trimesh.convex.convex_hull(points[side]) for side in (along < 0.005, along > -0.005)]
    trimesh.util.concatenate(pieces).export(banana / "collision.ply")
    (objects / "info_pick_v0.json").write_text(
        json.dumps({"011_banana": {"bbox": box, "scales": [1.0], "density": 600}})
    )
    return home


@pytest.mark.parametrize("name", TASKS)
def test_downloaded_objects_are_measured_and_worked(downloads, downloaded_to, name):
    downloaded_to(downloads)
    task = make_task(name, assets="maniskill")
    try:
        attempt = task.demonstrate(2)
        assert attempt.success, attempt.failure
        task.reset(2)
        execution = task.execute(downsample(attempt.demonstration.trajectory))
        assert execution.success, execution.failure
    finally:
        task.close()


@pytest.mark.parametrize(
    ("name", "download"),
    zip(TASKS, ("ycb", *2 * ["partnet_mobility_cabinet"], "partnet_mobility_faucet"), strict=True),
)
def test_without_the_downloads_one_line_says_how_to_get_them(downloaded_to, tmp_path, name, download):
    downloaded_to(tmp_path)
    with pytest.raises(RipError, match=f"mani_skill.utils.download_asset {download}") as told:
        make_task(name, assets="maniskill")
    assert len(str(told.value).splitlines()) == 1


def test_push_cube_needs_no_downloads_and_says_so():
    with pytest.raises(UnknownNameError, match="known: code"):
        make_task("push-cube", assets="maniskill")
