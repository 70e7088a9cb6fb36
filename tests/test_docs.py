"""The documentation: what its pages tell to type, the package and the terms that they write, the notebook, the site."""

import ast
import inspect
import json
import re
import shlex
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

from playground import registry
from playground.config import compose
from playground.errors import UnknownNameError
from playground.randomization import Randomizer
from playground.rendering.gl import find_gl
from playground.robots.scene import build_scene
from playground.sweep.plan import compose_jobs

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"
PAGES = (*DOCS.glob("*.md"), REPOSITORY / "README.md")
NOTEBOOK = DOCS / "first_policy.ipynb"
# Names that a page introduces itself, and the one that a page misspells.
OWN = ("SlideToTarget", "go1_worn", "enrgy")


def blocks(page: str, language: str) -> list[str]:
  """The fenced code of a page, in order."""
  return re.findall(rf"^```{language}\n(.*?)^```$", (DOCS / page).read_text(encoding="utf-8"), re.S | re.M)


def files(page: str) -> dict[str, str]:
  """The files that a page writes out: a line with the name alone, then the content."""
  text = (DOCS / page).read_text(encoding="utf-8")
  return dict(re.findall(r"^`([\w./-]+)`\n\n```\w+\n(.*?)^```$", text, re.S | re.M))


def run_commands() -> list[tuple[str, ...]]:
  """What follows `playground-run` on the lines to type, in all pages, but for those with a name to fill in."""
  text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES).replace("\\\n", " ")
  lines = re.findall(r"^playground-run +(.*)$", text, re.M)
  commands = {tuple(shlex.split(line, comments=True)) for line in lines}
  return sorted(words for words in commands if not any(sign in word for word in words for sign in "<…"))


def names(words: tuple[str, ...], *of: str) -> bool:
  return any(name in word for word in words for name in of)


@pytest.mark.parametrize("words", [words for words in run_commands() if not names(words, *OWN)], ids=" ".join)
def test_a_command_composes(words: tuple[str, ...]):
  overrides = [word for word in words if "=" in word]
  if "-m" in words:  # one seed stands for all
    assert compose_jobs([word for word in overrides if not word.startswith("seed=")] + ["seed=1"])
  else:
    compose(overrides)


def test_every_pip_finds_the_extras_that_are_told():
  """The pip of Python 3.11 finds no name with an underscore: it warns, and installs the package without the extra."""
  project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
  extras = project["optional-dependencies"]
  assert [name for name in extras if re.search("[_.A-Z]", name)] == []
  told = "\n".join(path.read_text(encoding="utf-8") for path in (*PAGES, REPOSITORY / "Makefile"))
  names = set(re.findall(r"(?:playground-run|'\.)\[([\w.-]+)\]", told))
  assert {"rsl-rl", "deploy", "web", "cuda13", "dev"} <= names <= set(extras)


def test_the_tutorials_mistake_is_answered_as_it_says():
  (words,) = (words for words in run_commands() if names(words, "enrgy"))
  with pytest.raises(UnknownNameError) as caught:
    compose(list(words))
  assert f"error: {caught.value}\n" in (DOCS / "tutorial.md").read_text(encoding="utf-8")


def test_the_page_on_tasks_makes_a_package_that_works(tmp_path: Path):
  written = files("add-a-task.md")
  for name, text in written.items():
    path = tmp_path / Path(name).relative_to("my-tasks")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
  points = tomllib.loads(written["my-tasks/pyproject.toml"])["project"]["entry-points"]["playground.tasks"]
  info = tmp_path / "my_tasks-0.1.0.dist-info"  # as pip would leave it
  info.mkdir()
  (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-tasks\nVersion: 0.1.0\n")
  lines = [f"{name} = {target}" for name, target in points.items()]
  (info / "entry_points.txt").write_text("\n".join(["[playground.tasks]", *lines]))
  code = f"""
    import sys
    sys.path.append({str(tmp_path)!r})
    import jax
    import jax.numpy as jnp
    from playground import registry
    from playground.config import compose

    run = compose(["env=SlideToTarget", "env.reward.scales.effort=-0.5"])
    assert run.choices["tuned"] == "ppo/SlideToTarget" and run.env.reward.scales.effort == -0.5
    env = registry.build(run.env)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    after = jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
    kinds = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)
    assert kinds(state) == kinds(after)

    there, away = (env.physics.make(qpos=[x], mocap_pos=[[0.3, 0.0, 0.2]]) for x in (0.3, -0.3))
    there, away = (env.evaluate(data, {{}}, jnp.ones(1)) for data in (there, away))
    assert abs(there.metrics["distance_m"]) < 1e-6 and abs(there.reward - 0.5) < 1e-5
    assert abs(away.metrics["distance_m"] - 0.6) < 1e-5 and 0 < away.metrics["reward/near"] < 0.1, away.metrics
    """
  done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True)
  assert done.returncode == 0, done.stderr


def test_the_page_on_randomisation_writes_terms_that_fit_and_code_that_runs():
  (text,) = files("randomization.md").values()
  terms = yaml.safe_load(text)["terms"]
  assert len(Randomizer(build_scene("go1").compile(), terms).describe()) == 4
  (code,) = blocks("randomization.md", "python")
  scope: dict[str, Any] = {}
  exec(code, scope)
  assert scope["fields"]["body_mass"].shape == (1024, scope["env"].mj_model.nbody)


def cells() -> list[str]:
  """The notebook's code."""
  found = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
  return ["".join(cell["source"]) for cell in found if cell["cell_type"] == "code"]


def test_the_notebook_is_committed_without_outputs():
  found = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
  assert not any(cell["outputs"] or cell["execution_count"] for cell in found if cell["cell_type"] == "code")


def test_what_the_notebook_imports_is_there_and_takes_what_it_is_given():
  tree = ast.parse("\n".join(cells()))
  scope: dict[str, Any] = {}
  for node in ast.walk(tree):
    if isinstance(node, ast.Import | ast.ImportFrom):
      exec(ast.unparse(node), scope)
  for node in ast.walk(tree):
    if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in scope:
      assert hasattr(scope[node.value.id], node.attr), ast.unparse(node)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in scope:
      function = scope[node.func.id]
      if function.__module__.startswith("playground"):
        inspect.signature(function).bind(*node.args, **{str(word.arg): word.value for word in node.keywords})


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path):
  import nbformat
  from nbclient import NotebookClient

  notebook = nbformat.read(NOTEBOOK, as_version=4)
  (parameters,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ()))
  parameters.source += '\nsettings += ["debug=fast"]'
  NotebookClient(notebook, timeout=600, resources={"metadata": {"path": tmp_path}}).execute()
  outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
  kinds = {kind for output in outputs for kind in output.get("data", ())}
  said = "".join(output.get("text", "") for output in outputs)
  assert "image/png" in kinds and "mean reward of 400 decisions" in said
  shown = any("video/mp4" in output.get("data", {}).get("text/html", "") for output in outputs)
  assert shown if find_gl() else "No video" in said


def test_the_site_builds_with_every_link_and_reference_found(tmp_path: Path):
  command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path / "site")]
  done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
  page = (tmp_path / "site/reference/configs/hardware.html").read_text(encoding="utf-8")
  assert "full float32, TF32 ruins some contact-rich tasks" in page  # beside a key, in configs/hardware/auto.yaml
  page = (tmp_path / "site/reference/api/parts-of-tasks.html").read_text(encoding="utf-8")
  assert 'id="playground.mdp.tolerance.tolerance"' in page


def test_the_gallery_shows_every_task() -> None:
  text = (DOCS / "gallery.md").read_text()
  for task in registry.ALL_ENVS:
    assert text.count(f"](gallery/{task}.webp)") == 1 and f"**{task}**" in text, task
    assert (DOCS / "gallery" / f"{task}.webp").is_file()
