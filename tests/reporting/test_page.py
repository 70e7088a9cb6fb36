"""Pages as Markdown and HTML, drawings, and the text of numbers."""

import numpy as np
import pytest

from playground.reporting import figures
from playground.reporting.page import Heading, Image, Link, Table, Text, mean_and_ci95, to_html, to_markdown


@pytest.mark.filterwarnings("error")
def test_a_long_setting_leaves_room_for_the_drawing():
  name = "CartpoleBalance " + " ".join(f"agent.some_long_key_{i}=64" for i in range(6))
  drawings = [
    figures.lines("a", {name: [(1, 2.0), (2, 4.0)], f"{name}, training": [(1, 1.0)]}, "x", "y"),
    figures.bars("a", {name: {"fixed": 1.0, "scaled": 2.0}}, "x"),
    figures.stacked("a", {name: {"physics": 0.5, "update": 0.5}}, "x"),
  ]
  drawings.append(
    figures.curves({name: {f"{name} {i}": figures.Curve([0, 1], [0, 1]) for i in range(4)}}, "x", "y").decode()
  )
  assert all("<svg" in drawing for drawing in drawings)


def test_blocks_as_markdown_and_html():
  blocks = [
    Heading(2, "A & B"),
    Text("run `it`"),
    Table(["a", "b"], [["x|y", "1"]]),
    Image("p", "<?xml?><svg/>", "C"),
  ]
  assert to_markdown(blocks, "d") == (
    "## A & B\n\nrun `it`\n\n| a | b |\n| --- | ---: |\n| x\\|y | 1 |\n\n![C](d/p.svg)\n"
  )
  html = to_html(blocks, "T")
  for part in ("<h2>A &amp; B</h2>", "<code>it</code>", '<td class="n">1</td>', "<svg/>", "<figcaption>C</figcaption>"):
    assert part in html
  assert "<?xml" not in html


def test_a_png_and_a_link_are_html():
  curve = figures.Curve([1.0, 2.0], [3.0, 4.0], [0.1, 0.2])
  png = figures.curves({"task": {"ppo": curve}}, "steps", "return", "png")
  html = to_html([Image("p", png, ""), Table(["job"], [[Link("0<1", "jobs/0/")]])], "T")
  assert png.startswith(b"\x89PNG") and 'src="data:image/png;base64,' in html
  assert '<td><a href="jobs/0/">0&lt;1</a></td>' in html


def test_interval_is_students():
  mean, half = mean_and_ci95([1.0, 2.0, 3.0, 4.0, 5.0])
  assert mean == 3.0 and half is not None
  np.testing.assert_allclose(half, 2.776445 * np.sqrt(2.5 / 5), rtol=1e-6)  # t(0.975, 4 degrees of freedom)
  assert mean_and_ci95([7.0]) == (7.0, None)
