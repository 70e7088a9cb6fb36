"""The documentation: the commands of its pages, the packages and events that they write, the notebook, the site."""

import ast
import csv
import functools
import importlib.util
import inspect
import io
import itertools
import json
import os
import re
import shlex
import subprocess
import sys
import tokenize
import tomllib
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import pytest
import yaml

from playground import registry
from playground.catalog import entries
from playground.cli.main import _parser
from playground.config import compose, config_dict, override_section
from playground.deploy.export import export_run
from playground.errors import UnknownNameError
from playground.mdp import terms
from playground.physics.backend import Physics
from playground.randomization import Randomizer
from playground.rendering.gl import find_gl
from playground.robots.scene import build_scene, find_mjcf
from playground.sweep.plan import compose_jobs
from tests.packages import PACKAGES, install, run

REPOSITORY = Path(__file__).parents[1]
DOCS = REPOSITORY / "docs"
README = REPOSITORY / "README.md"
PAGES = (*DOCS.glob("*.md"), README)
NOTEBOOK = DOCS / "first_policy.ipynb"
MISTAKE = "joint_powr_l1"  # which a page misspells
TOP_LEVEL = ("CONTRIBUTING.md", "CHANGELOG.md", "AGENTS.md", "llms.txt")
BANNED = (
  *("decisions?", "fresh starts?", "slips?", "(?<!standard )deviations?", "passes over the data", "paid for", "afresh"),
  *("anew", "pictures?", "stands? by", "eyes?", "facts?", "told", "learners?", "the like", "what there is"),
  *(
    "what is kept",
    "is one sentence",
    "tapes?",
    "houses?",
    "learnt",
    "likewise",
    "as ever",
    "is answered",
    "who wants",
  ),
)
# Names that a page introduces itself.
OWN = ("SlideToTarget", "go1_worn", "=pup", "PupJoystick", "go1_in_wind", "reinforce", MISTAKE)
# Pages that write out the files of a package of tests/packages, and the files that only the page has.
PACKAGE_PAGES = {"add-a-robot.md": "robot_only", "add-a-reward.md": "terms_only", "add-an-algorithm.md": "reinforce"}
ONLY_ON_A_PAGE = ("robot_only/robot_only/configs/env/PupJoystick.yaml",)


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
  lines = re.findall(r"^(?:playground-run|playground train) +(.*)$", text, re.M)
  commands = {tuple(shlex.split(line, comments=True)) for line in lines}
  return sorted(words for words in commands if not any(sign in word for word in words for sign in "<…"))


def other_commands() -> list[tuple[str, ...]]:
  """What follows `playground` on the lines to type, in all pages, but for `train` and `bench`."""
  pages = (re.findall(r"^```\n(.*?)^```$", page.read_text(encoding="utf-8"), re.S | re.M) for page in PAGES)
  text = "\n".join(itertools.chain(*pages)).replace("\\\n", " ")
  lines = re.findall(r"^playground ((?!train|bench)[a-z-]+ .*)$", text, re.M)
  return sorted({tuple(shlex.split(line.partition(" | ")[0], comments=True)) for line in lines})


def names(words: tuple[str, ...], *of: str) -> bool:
  return any(name in word for word in words for name in of)


@pytest.mark.parametrize("words", [words for words in run_commands() if not names(words, *OWN)], ids=" ".join)
def test_a_command_composes(words: tuple[str, ...]):
  overrides = [word for word in words if "=" in word and not word.startswith("trust=")]
  if "-m" in words:  # one seed stands for all
    assert compose_jobs([word for word in overrides if not word.startswith("seed=")] + ["seed=1"])
  else:
    compose(overrides)


@pytest.mark.parametrize("words", other_commands(), ids=" ".join)
def test_a_command_has_such_options(words: tuple[str, ...]):
  _, unknown = _parser().parse_known_args(words)  # overrides that stand after options
  assert not [word for word in unknown if "=" not in word]


def test_the_readme_is_short_and_its_pictures_are_there():
  text = README.read_text(encoding="utf-8")
  assert len(text.splitlines()) <= 120
  for page in PAGES:
    for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
      assert (page.parent / picture).is_file(), f"{page.name}: {picture}"


def test_the_readme_counts_as_the_catalogue_does():
  cells = re.findall(r"\| (\d+) (?:task:|tasks, such as) (\w+) ", README.read_text(encoding="utf-8"))
  shown = {entries()[task].status: int(number) for number, task in cells}
  assert shown == Counter(entry.status for entry in entries().values())


def test_the_readmes_returns_are_those_of_the_reference_tables():
  """To the decimals that the README has, of the row's task."""
  returns: dict[str, list[float]] = {}
  for table in (REPOSITORY / "results/reference").glob("*.csv"):
    rows = csv.DictReader(table.read_text(encoding="utf-8").splitlines())
    for row in (row for row in rows if row.get("task")):
      values = [value for name, value in row.items() if value and (name == "value" or "return" in str(name))]
      returns.setdefault(row["task"], []).extend(float(value) for value in values if re.fullmatch(r"-?[\d.]+", value))
  section = README.read_text(encoding="utf-8").split("## Results")[1].split("\n## ")[0]
  rows = re.findall(r"^\| ([A-Z]\w+)( from pixels)?[^|]*\| ([^|]*) \|[^|]*\| ([^|]*) \|$", section, re.M)
  assert len(rows) >= 8
  for task, vision, *cells in rows:
    for number in (found[0] for cell in cells if (found := re.match(r"[\d.]+", cell))):
      step = 10.0 ** -len(number.partition(".")[2])
      near = [
        value for value in returns[task + "Vision" * bool(vision)] if abs(value - float(number)) <= step / 2 + 1e-9
      ]
      assert near, f"{task}: {number}"


def test_the_readmes_configuration_is_one():
  (block,) = re.findall(r"^```yaml\n(.*?)^```$", README.read_text(encoding="utf-8"), re.S | re.M)
  values = yaml.safe_load(block)
  task = yaml.safe_load((REPOSITORY / "configs/env/Go1JoystickFlatTerrain.yaml").read_text(encoding="utf-8"))
  assert values.pop("defaults") == task["defaults"]
  env = registry.config("Go1JoystickFlatTerrain")
  section = override_section("env", env, {f"{k}.{name}": v for k, terms in values.items() for name, v in terms.items()})
  registry.build(config_dict(section))


def _without_dynamics(physics: Physics, *args: Any, _init: Any = Physics.__init__, **kwargs: Any) -> None:
  _init(physics, *args, **kwargs)
  vars(physics).update(vars(physics.without_dynamics()))


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_readmes_python_runs(compiled: bool, monkeypatch: pytest.MonkeyPatch):
  """Without compiling, its functions are traced."""
  (code,) = re.findall(r"^```python\n(.*?)^```$", README.read_text(encoding="utf-8"), re.S | re.M)
  if not compiled:
    monkeypatch.setattr(jax, "jit", lambda function: functools.partial(jax.eval_shape, function))
    monkeypatch.setattr(Physics, "__init__", _without_dynamics)
  scope: dict[str, Any] = {}
  exec(code, scope)
  assert scope["env"].config.rewards.joint_power_l1.weight == -0.002
  assert scope["state"].reward.shape == ()


@pytest.mark.parametrize("page", [*PAGES, *(REPOSITORY / name for name in TOP_LEVEL)], ids=lambda page: page.name)
def test_a_page_has_the_fields_words(page: Path):
  """Words of our own that a reader would have to learn."""
  text = re.sub("`[^`\n]+`", "", page.read_text(encoding="utf-8").lower())
  assert [word for word in BANNED if re.search(rf"\b{word}\b", text)] == []


def test_docstrings_comments_and_messages_have_the_fields_words():
  found = []
  for path in sorted((REPOSITORY / "playground").rglob("*.py")):
    source = path.read_text(encoding="utf-8")
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    texts = [token.string for token in tokens if token.type == tokenize.COMMENT]
    constants = [node.value for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Constant)]
    texts += [value for value in constants if isinstance(value, str) and " " in value]
    text = re.sub(r"`[^`\n]+`|^ *\**\w+:", "", "\n".join(texts).lower(), flags=re.M)  # code, names of parameters
    found += [f"{path.name}: {word}" for word in BANNED if re.search(rf"\b{word}\b", text)]
  assert found == []


def test_every_pip_finds_the_extras_that_are_told():
  """The pip of Python 3.11 finds no name with an underscore: it warns, and installs the package without the extra."""
  project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
  extras = project["optional-dependencies"]
  assert [name for name in extras if re.search("[_.A-Z]", name)] == []
  told = "\n".join(path.read_text(encoding="utf-8") for path in (*PAGES, REPOSITORY / "Makefile"))
  names = set(re.findall(r"(?:playground-run|'\.)\[([\w.-]+)\]", told))
  assert {"rsl-rl", "deploy", "web", "cuda13", "dev"} <= names <= set(extras)


def test_the_images_and_the_cloud_task_name_known_extras():
  """Neither can be run here."""
  text = (REPOSITORY / "Dockerfile").read_text(encoding="utf-8")
  assert re.findall(r"^FROM \S+ AS (\S+)$", text, re.M) == ["base", "cpu", "cuda"]
  task = yaml.safe_load((REPOSITORY / "sky.yaml").read_text(encoding="utf-8"))
  assert set(task) == {"name", "resources", "workdir", "envs", "setup", "run"}
  compose(shlex.split(task["envs"]["RUN"]))
  project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
  named = re.findall(r"'\.\[([\w,-]+)\]'", text + task["setup"])
  assert len(named) == 3 and set(",".join(named).split(",")) <= set(project["optional-dependencies"])


def test_the_tutorials_mistake_is_answered_as_it_says():
  (words,) = (words for words in run_commands() if names(words, MISTAKE))
  with pytest.raises(UnknownNameError) as caught:
    registry.build(compose(list(words)).env)
  assert f"error: {caught.value}\n" in (DOCS / "tutorial.md").read_text(encoding="utf-8")


def test_the_page_on_tasks_makes_a_package_that_works(tmp_path: Path):
  site = install(write(files("add-a-task.md"), tmp_path) / "my-tasks", tmp_path / "site")
  code = """
    import jax
    import jax.numpy as jnp
    from playground import registry
    from playground.config import compose

    config = compose(["env=SlideToTarget", "env.rewards.action_l2.weight=-0.5", "env.noise_level=0"])
    assert config.choices["tuned"] == "ppo/SlideToTarget" and config.env.rewards.action_l2.weight == -0.5
    env = registry.build(config.env)
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    after = jax.eval_shape(env.step, state, jnp.zeros(env.action_size))
    kinds = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)
    assert kinds(state) == kinds(after)
    assert env.observation_parts == {"state": {"joint_pos": 1, "joint_vel": 1, "target_offset": 1}}

    env.physics = env.physics.without_dynamics()
    info = env.reset(jax.random.PRNGKey(0)).info
    there, away = (env.physics.make(qpos=[x], mocap_pos=[[0.3, 0.0, 0.2]]) for x in (0.3, -0.3))
    there, away = (env.post_step(data, info, jnp.ones(1)) for data in (there, away))
    assert abs(there.metrics["distance_m"]) < 1e-6 and abs(there.reward - 0.5 * env.dt) < 1e-5
    assert abs(away.obs[2] - 0.6) < 1e-5 and 0 < away.metrics["reward/near_target"] < 0.1, away.metrics
    """
  run(site, "-c", code)


def write(contents: dict[str, str], folder: Path) -> Path:
  for name, text in contents.items():
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
  return folder


@pytest.mark.parametrize(("page", "package"), PACKAGE_PAGES.items())
def test_a_page_shows_the_package_that_tests_install(page: str, package: str):
  shown = {name: text for name, text in files(page).items() if name not in ONLY_ON_A_PAGE}
  there = [path for path in (PACKAGES / package).rglob("*.*") if path.is_file() and path.suffix != ".pyc"]
  assert shown == {path.relative_to(PACKAGES).as_posix(): path.read_text(encoding="utf-8") for path in there}


def test_the_commands_and_the_code_of_the_pages_on_packages(tmp_path: Path):
  """tests/test_openness.py tests what the packages do."""
  written = write({name: text for page in PACKAGE_PAGES for name, text in files(page).items()}, tmp_path / "written")
  for package in PACKAGE_PAGES.values():
    install(written / package, tmp_path / "site")
  commands = [words for words in run_commands() if names(words, "=pup", "PupJoystick", "go1_in_wind", "reinforce")]
  assert len(commands) >= 4
  (code,) = blocks("add-a-robot.md", "python")[1:]
  composed = f"""
from playground.config import compose
from playground.sweep.plan import compose_jobs
for words in {commands!r}:
  overrides = [word for word in words if "=" in word]
  compose_jobs(overrides) if "-m" in words else compose(overrides)
config = compose(["env=PupJoystick"]).env
assert config.robot.name == "pup" and config.rewards.feet_clearance.weight == -2.0
assert config.commands.velocity.params.max == [0.8, 0.4, 1.0]
"""
  said = run(tmp_path / "site", "-c", composed + code)
  assert re.search(r"height 0\.2[345]\d m", said) and "[1, 1, 1, 1]" in said, said


def test_the_controller_of_the_page_on_deployment_walks(tmp_path: Path):
  code = files("deploy.md")["walk.py"]
  assert not re.search(r"^ *(import|from) (jax|playground)", code, re.M), "without this package"
  (tmp_path / "walk.py").write_text(code, encoding="utf-8")
  assert export_run("pretrained:Go1JoystickFlatTerrain", out=str(tmp_path)) == 0
  command = [sys.executable, "walk.py", ".", str(find_mjcf("go1"))]
  said = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout
  found = re.fullmatch(r"walked ([\d.]+) m in 10 s, height ([\d.]+) m\n", said)
  assert found is not None and float(found.group(1)) > 8 and float(found.group(2)) > 0.25


def test_the_page_on_randomisation_writes_events_that_fit_and_code_that_runs():
  (text,) = files("randomization.md").values()
  model, events = build_scene("go1").compile(), yaml.safe_load(text)
  assert [len(Randomizer(model, events, mode)._draws) for mode in ("startup", "reset")] == [3, 1]
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
  assert "image/png" in kinds and "mean reward of 400 steps" in said
  shown = any("video/mp4" in output.get("data", {}).get("text/html", "") for output in outputs)
  assert shown if find_gl() else "No video" in said


def test_every_key_of_the_reference_has_a_meaning_on_a_short_page():
  """A page of 120 rows has about 5,000 pixels."""
  spec = importlib.util.spec_from_file_location("hooks", DOCS / "hooks.py")
  assert spec is not None and spec.loader is not None
  hooks = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(hooks)
  pages = {
    uri: [line for line in text.splitlines() if line.startswith("| ")] for uri, text in hooks.reference_pages().items()
  }
  assert len(pages) > 40 and sum(map(len, pages.values())) > 1500
  assert [row for rows in pages.values() for row in rows if row.endswith("|  |")] == []
  assert {uri: len(rows) for uri, rows in pages.items() if len(rows) > 120} == {}


@pytest.mark.slow
def test_the_site_builds_without_a_repository(tmp_path: Path):
  command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path / "site")]
  environment = {name: value for name, value in os.environ.items() if name != "REPOSITORY"}
  done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
  assert "edit/main" not in (tmp_path / "site/tutorial.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_site_builds_with_every_link_and_reference_found(tmp_path: Path):
  command = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(tmp_path / "site")]
  environment = os.environ | {"REPOSITORY": "https://example.org/me/fork"}
  done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
  page = (tmp_path / "site/tutorial.html").read_text(encoding="utf-8")
  assert 'href="https://example.org/me/fork/edit/main/docs/tutorial.md"' in page
  page = (tmp_path / "site/reference/configs/hardware.html").read_text(encoding="utf-8")
  assert "full float32, TF32 ruins some contact-rich tasks" in page  # beside a field of HardwareConfig
  assert (
    'src="../../iframe-worker.js"' in page and "unpkg" not in page and (tmp_path / "site/iframe-worker.js").is_file()
  )
  page = (tmp_path / "site/reference/configs/env-joystick.html").read_text(encoding="utf-8")
  assert "Warp: constraint rows of one environment" in page  # beside a field of EnvConfig
  pages = {kind: tmp_path / f"site/reference/configs/terms-{kind}.html" for kind in terms.MODULES}
  assert "feet_air_time" in pages["rewards"].read_text(encoding="utf-8") and all(map(Path.is_file, pages.values()))
  page = (tmp_path / "site/reference/api/mdp-tolerance.html").read_text(encoding="utf-8")
  assert 'id="playground.mdp.tolerance.tolerance"' in page


def test_the_gallery_shows_every_task() -> None:
  text = (DOCS / "gallery.md").read_text()
  for task in registry.ALL_ENVS:
    assert text.count(f"](gallery/{task}.webp)") == 1 and f"**{task}**" in text, task
    assert (DOCS / "gallery" / f"{task}.webp").is_file()
