"""Contact sheets."""

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from playground import registry
from playground.errors import ConfigError
from playground.rendering.views import save_views, sheet
from tests.test_randomization import events

LIGHT = {"field": "light_diffuse", "target": "all", "operation": "scale", "range": [0.0, 1.0]}


def test_images_lie_in_rows_with_gaps() -> None:
  page = sheet(np.arange(5, dtype=np.uint8)[:, None, None, None] * np.ones((1, 3, 4, 1), np.uint8))
  assert page.shape == (2 * 5, 3 * 6, 3) and page.dtype == np.uint8
  assert [page[1, 1, 0], page[1, 7, 1], page[6, 8, 2]] == [0, 1, 4]
  assert (page[3] == 255).all() and (page[6, 14] == 255).all()


def test_what_cannot_be_shown(tmp_path: Path) -> None:
  blind = registry.load("CartpoleBalance")
  with pytest.raises(ConfigError, match=r"has no images: add env.vision.enable=true .* of fixed, lookatcart"):
    save_views(blind, {}, tmp_path / "views.png")
  with pytest.raises(ConfigError, match=r"--views=views\.jpg must be a file that ends in \.png\."):
    save_views(blind, {}, "views.jpg")
  with pytest.raises(ConfigError, match="--num-views=0 must be above 0"):
    save_views(blind, {}, "views.png", count=0)
  (tmp_path / "file").touch()
  seeing = registry.load("CartpoleBalanceVision")
  with pytest.raises(ConfigError, match=r"^--views=.*png cannot be written: .*/file is not a folder that you may"):
    save_views(seeing, {}, tmp_path / "file/views.png")
  with pytest.raises(ConfigError, match="lamp"):
    save_views(seeing, events(LIGHT | {"target": "lamp"}), tmp_path / "new/views.png")
  assert [path.name for path in tmp_path.iterdir()] == ["file"], "a folder is made when there is what to put into it"


@pytest.mark.slow
def test_views_differ_by_what_is_drawn(tmp_path: Path) -> None:
  env = registry.load("CartpoleBalanceVision", overrides={"vision.width": 16, "vision.height": 16})
  page = matplotlib.image.imread(save_views(env, events(LIGHT), tmp_path / "new/views.png", count=2))
  assert page.shape[:2] == (18, 36)
  left, right = (page[:16, x : x + 16, :3].max() for x in (0, 18))  # where it is brightest, poses make no difference
  assert 0 < left != right > 0
