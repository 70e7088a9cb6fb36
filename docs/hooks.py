"""Pages that `make docs` makes: the reference, from docstrings, settings classes and configs/, and the notebook's."""

import dataclasses
import inspect
import itertools
import json
from pathlib import Path

import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from playground.config.comments import flow, keys_and_comments
from playground.config.definitions import RunSettings, defined
from playground.config.files import task_experiments
from playground.config.sweep_options import SweepConfig
from playground.envs.options import TermsConfig
from playground.settings import Setting, settings

ROOT = Path(__file__).parents[1]
REFERENCE = "results/reference"
NOTEBOOK = ROOT / "docs/first_policy.ipynb"
# Pages of the API's reference: modules, and packages all of whose modules are meant.
API = {
  "Tasks": ["registry", "envs.task", "envs.base", "physics.backend", "envs.wrappers", "rendering.vision"],
  "Parts of tasks": ["mdp"],
  "Randomisation": ["randomization"],
  "Scenes": ["robots.scene", "robots.terrain", "robots.tabletop", "robots.in_hand"],
  "Learning": ["learning"],
  "Runs": [
    "config.run_config",
    "config.composition",
    "runs.train",
    "runs.loaded_policy",
    "runs.run_dir",
    "rendering.video",
  ],
  "Adapters": ["adapters"],
  "Deployment": ["deploy"],
}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
  """Puts the generated pages into the navigation."""
  assert config.nav is not None, "mkdocs.yml has one"
  api = [{title: _uri("api", title)} for title in API]
  groups = [{group or "config.yaml": _uri("configs", group or "config")} for group in _groups()]
  config.nav.append({"Reference": [{"Python": api}, {"Configuration": groups}]})
  return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
  """Adds the generated pages."""
  pages = {_uri("api", title): _api_page(title, modules) for title, modules in API.items()}
  pages |= {_uri("configs", group or "config"): _group_page(group) for group in _groups()}
  pages["first_policy.md"] = _notebook_page()
  for uri, content in pages.items():
    files.append(File.generated(config, uri, content=content))
  for curve in sorted((ROOT / REFERENCE).glob("*.png")):
    files.append(File.generated(config, f"curves/{curve.name}", abs_src_path=str(curve)))
  return files


def on_page_markdown(markdown: str, **_: object) -> str:
  """Lets pages of the site show the curves that lie outside of docs/, where the pages of the repository find them."""
  return markdown.replace(f"](../{REFERENCE}/", "](curves/")


def on_post_page(output: str, page: Page, **_: object) -> str:
  """Takes the script that searching in a file needs from the site itself: nothing is fetched when a page is read."""
  return output.replace("https://unpkg.com/iframe-worker/shim", "../" * page.url.count("/") + "iframe-worker.js")


def _uri(folder: str, title: str) -> str:
  return f"reference/{folder}/{title.lower().replace(' ', '-').replace('/', '-')}.md"


def _api_page(title: str, modules: list[str]) -> str:
  names = []
  for module in modules:
    folder = ROOT / "playground" / module.replace(".", "/")
    inside = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
    names += [f"playground.{module}.{name}" for name in inside] or [f"playground.{module}"]
  return f"# {title}\n\n" + "\n\n".join(f"::: {name}" for name in names) + "\n"


def _groups() -> list[str]:
  """The configuration's groups, that of config.yaml itself ("") first, and each tuned set's agent as a group."""
  configs = ROOT / "configs"
  of_files = {path.parent.relative_to(configs).as_posix() for path in configs.glob("*/**/*.yaml")}
  return ["", *sorted(of_files | set(defined()))]


def _group_page(group: str) -> str:
  """Every option of a group, those of classes first: what it is, its keys, their values and what is said of them."""
  parts = [f"# {f'configs/{group}' if group else 'config.yaml'}\n"]
  classes = (
    defined().get(group, {})
    if group
    else {"A run": RunSettings, "env of a task made of terms": TermsConfig, "A sweep": SweepConfig}
  )
  parts += [_class_section(name, cls) for name, cls in classes.items()]
  parts += [_experiments()] if group == "experiment" else []
  shared_first = lambda path: (path.stem[0].isupper(), path.stem)
  for path in sorted((ROOT / "configs" / group).glob("*.yaml"), key=shared_first):
    lines = path.read_text(encoding="utf-8").splitlines()
    head = list(itertools.takewhile(lambda line: line.startswith("#"), lines))
    said = " ".join(line[1:].strip() for line in head if not line.startswith("# @package"))
    parts.append(f"## {path.stem}\n\n{_text(said)}\n")
    keys = list(keys_and_comments("\n".join(lines)))
    bases = [base for key, value, _ in keys if key == "defaults" for base in yaml.safe_load(value) if base != "_self_"]
    if bases:
      parts.append("On top of " + ", ".join(_code(flow(base)) for base in bases) + ".\n")
    rows = [f"| {_code(key)} | {_code(value)} | {_text(said)} |" for key, value, said in keys if key != "defaults"]
    if rows:
      parts.append("\n".join(["| key | value | |", "|---|---|---|", *rows]) + "\n")
  return "\n".join(parts)


def _experiments() -> str:
  """The experiments that have no file."""
  rows = [f"| {_code(name)} | {_code(task)} |" for name, task in sorted(task_experiments([ROOT / "configs"]).items())]
  head = "Every task has an experiment of its name, which chooses it with its tuned set. Those below have files.\n"
  return "\n".join([head, "| experiment | task |", "|---|---|", *rows, ""])


def _class_section(name: str, cls: type) -> str:
  """The settings that a class defines."""
  head = [f"## {name}\n", f"{_text(inspect.getdoc(cls) or '')}\n"]
  rows = [_setting_row(setting) for setting in settings(cls).values() if setting.default is not dataclasses.MISSING]
  return "\n".join([*head, "| key | default | allowed | |", "|---|---|---|---|", *filter(None, rows), ""])


def _setting_row(setting: Setting) -> str:
  if isinstance(setting.default, dict) and setting.default:  # a nested class: its fields have rows of their own
    return ""
  allowed = ", ".join(map(_code, setting.choices)) if setting.choices else str(setting.limit or "")
  allowed += " or null" if setting.nullable and allowed else ""
  return f"| {_code(setting.name)} | {_code(flow(setting.default))} | {allowed} | {_text(setting.help)} |"


def _code(text: str) -> str:
  return f"`{text}`".replace("|", "\\|") if text else ""


def _text(comment: str) -> str:
  """A comment in a cell: what looks like HTML or a column's end outside of `code` is neither."""
  parts = comment.replace("|", "\\|").split("`")
  return "`".join(part if i % 2 else part.replace("<", "&lt;") for i, part in enumerate(parts))


def _notebook_page() -> str:
  """The notebook's cells, without outputs, and where the notebook itself lies."""
  cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
  texts = [(cell["cell_type"], "".join(cell["source"])) for cell in cells]
  page = [text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in texts]
  return "\n\n".join([*page, f"The notebook: [{NOTEBOOK.name}]({NOTEBOOK.name})."]) + "\n"
