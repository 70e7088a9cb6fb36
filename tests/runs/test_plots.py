from pathlib import Path

import pytest
from matplotlib.figure import Figure

from playground.runs.plots import plot_learning_curve

HEADER = "step,eval/episode_reward,eval/episode_reward_std,time/wall_clock_s,loss\n"


@pytest.mark.parametrize("content", [None, "", "step,loss\n1,0.5\n", HEADER + "1,,,3.0,0.5\n"])
def test_without_an_evaluation_nothing_is_drawn(tmp_path: Path, content: str | None):
  if content is not None:
    (tmp_path / "metrics.csv").write_text(content)
  assert plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "plots") == []
  assert not list(tmp_path.glob("plots/*"))


def test_both_curves_are_drawn(tmp_path: Path):
  rows = [f"{s * 10**6},{s * 90},{50 - s},{s * 30},\n{s * 10**6 + 5},,,,0.1\n" for s in range(11)]
  (tmp_path / "metrics.csv").write_text(HEADER + "".join(rows))
  written = plot_learning_curve(tmp_path / "metrics.csv", tmp_path / "plots")
  assert [p.name for p in written] == ["return_over_steps.png", "return_over_wall_clock.png"]
  assert sorted(tmp_path.glob("plots/*")) == sorted(written)
  assert all(p.read_bytes().startswith(b"\x89PNG") for p in written)


def test_one_evaluation_without_clock_or_std_draws_what_it_can(tmp_path: Path):
  (tmp_path / "metrics.csv").write_text("step,eval/episode_reward\n100,1.5\n")
  written = plot_learning_curve(tmp_path / "metrics.csv", tmp_path)
  assert [p.name for p in written] == ["return_over_steps.png"]


def test_the_other_way_to_act_has_a_line_and_both_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  (tmp_path / "metrics.csv").write_text("step,eval/episode_reward,eval/mode/episode_reward\n0,1.0,2.0\n100,5.0,6.0\n")
  drawn: list[Figure] = []
  monkeypatch.setattr(Figure, "savefig", lambda figure, path, **kwargs: drawn.append(figure))
  plot_learning_curve(tmp_path / "metrics.csv", tmp_path)
  (axes,) = drawn[0].axes
  lines = {line.get_label(): list(line.get_ydata()) for line in axes.lines}  # pyright: ignore[reportArgumentType]
  assert lines == {"mean, sampled": [1, 5], "mean, mode": [2, 6]}


def test_the_curve_of_a_chain_has_a_line_and_a_mark_for_each_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  rows = "0,flat,1.0\n100,flat,5.0\n100,rough,2.0\n200,rough,6.0\n"
  (tmp_path / "metrics.csv").write_text("step,stage,eval/episode_reward\n" + rows)
  drawn: list[Figure] = []
  monkeypatch.setattr(Figure, "savefig", lambda figure, path, **kwargs: drawn.append(figure))
  plot_learning_curve(tmp_path / "metrics.csv", tmp_path)
  (axes,) = drawn[0].axes
  assert [text.get_text() for text in axes.texts] == ["flat", "rough"]
  lines = [(list(line.get_xdata()), list(line.get_ydata())) for line in axes.lines]  # pyright: ignore[reportArgumentType]
  assert lines == [([0, 100], [1, 5]), ([0, 0], [0, 1]), ([100, 200], [2, 6]), ([100, 100], [0, 1])]
