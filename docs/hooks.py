"""Pages that `make docs` makes: the reference, from docstrings, settings classes and configs/, and the notebook's."""

import dataclasses
import inspect
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from playground.catalog import entries
from playground.config.comments import flow, keys_and_comments
from playground.config.definitions import RunSettings, defined, definition
from playground.config.files import task_experiments
from playground.config.sweep_options import SweepConfig
from playground.envs.options import TermsConfig
from playground.mdp.terms import MODULES, registered
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
  groups = [{"config.yaml" if title == "config" else title: _uri("configs", title)} for title in _groups()]
  terms = {"Terms of a task": _uri("configs", "terms")}
  config.nav.append({"Reference": [{"Python": api}, {"Configuration": [*groups, terms]}]})
  return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
  """Adds the generated pages."""
  pages = {_uri("api", title): _api_page(title, modules) for title, modules in API.items()}
  pages |= {_uri("configs", title): _group_page(title, group, paths) for title, (group, paths) in _groups().items()}
  pages[_uri("configs", "terms")] = _terms_page()
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


def _groups() -> dict[str, tuple[str, list[Path]]]:
  """The group and the files that each page shows, by title: config.yaml, then a page for each group and tuned set.

  Tasks have a page for each suite, and the files that they build on another.
  """
  configs = ROOT / "configs"
  of_files = {path.parent.relative_to(configs).as_posix() for path in configs.glob("*/**/*.yaml")}
  pages = {"config": ("", sorted(configs.glob("*.yaml")))}
  for group in sorted(of_files | set(defined())):
    for path in sorted((configs / group).glob("*.yaml")):
      known = entries().get(path.stem) if group == "env" else None
      pages.setdefault(f"{group} {known.suite}" if known else group, (group, []))[1].append(path)
    pages.setdefault(group, (group, []))
  return pages


def _group_page(title: str, group: str, paths: list[Path]) -> str:
  """Every option of a page, those of classes first: its keys, their values and their meaning."""
  parts = [f"# {f'configs/{title}' if group else 'config.yaml'}\n"]
  classes = (
    (defined().get(group, {}) if title == group else {})
    if group
    else {"A run": RunSettings, "env of a task made of terms": TermsConfig, "A sweep": SweepConfig}
  )
  parts += [_class_section(name, cls) for name, cls in classes.items()]
  parts += [_experiments()] if group == "experiment" else []
  shared_first = lambda path: (path.stem[0].isupper(), path.stem)
  for path in sorted(paths, key=shared_first):
    text = path.read_text(encoding="utf-8")
    head = list(itertools.takewhile(lambda line: line.startswith("#"), text.splitlines()))
    said = " ".join(line[1:].strip() for line in head if not line.startswith("# @package"))
    package = next((line.split()[-1] for line in head if line.startswith("# @package")), group)
    parts.append(f"## {path.stem}\n\n{_text(said)}\n")
    keys = list(keys_and_comments(text))
    bases = [base for key, value, _ in keys if key == "defaults" for base in yaml.safe_load(value) if base != "_self_"]
    if bases:
      parts.append("On top of " + ", ".join(_code(flow(base)) for base in bases) + ".\n")
    prefix, names = "" if package == "_global_" else f"{package}.", {"agent": _agent(group, path)}
    rows = [
      f"| {_code(term)} | {_code(entry)} | {_text(said or _help(prefix + term, entry, names))} |"
      for key, value, said in keys
      if key != "defaults"
      for term, entry in _terms(prefix, key, value)
    ]
    if rows:
      parts.append("\n".join(["| key | value | meaning |", "|---|---|---|", *rows]) + "\n")
  return "\n".join(parts)


def _agent(group: str, path: Path) -> str:
  """The agent whose keys a file of `agent` or `tuned/<agent>` sets; PPO, whose keys experiments set, for others."""
  name = path.stem if group == "agent" else group.removeprefix("tuned/")
  return next((agent for agent in defined()["agent"] if name.startswith(agent)), "ppo")


def _terms(prefix: str, key: str, value: str) -> Iterator[tuple[str, str]]:
  """Yields each term of a section that a file writes on one line, other keys as they are."""
  entry = yaml.safe_load(value) if value else None
  kind, *inside = (prefix + key).removeprefix("env.").split(".")
  if isinstance(entry, dict) and kind in MODULES and len(inside) < (2 if kind == "observations" else 1):
    for name, term in entry.items():
      yield from _terms(prefix, f"{key}.{name}", flow(term))
  else:
    yield key, value


def _help(key: str, value: str, names: Mapping[str, object]) -> str:
  """The help of a setting, or the first line of the docstring of the function that a term names; else empty."""
  kind, *inside = key.removeprefix("env.").split(".")
  if kind in MODULES and len(inside) == (2 if kind == "observations" else 1):
    entry = yaml.safe_load(value) if value else None
    name = entry.get("func", inside[-1]) if isinstance(entry, dict) else inside[-1]
    return "removes the term" if value == "null" else _summary(registered(kind).get(name))
  setting = definition(key, names)
  return setting.help if setting else ""


def _summary(function: Callable[..., object] | None) -> str:
  """The first line of a docstring; empty for a function of another package."""
  return (inspect.getdoc(function) or "").partition("\n")[0] if function else ""


def _terms_page() -> str:
  """The registered functions of each kind, with their parameters."""
  parts = [
    "# Terms of a task\n",
    "The registered functions. [Add a reward](../../add-a-reward.md) shows how to use them.\n",
  ]
  for kind in MODULES:
    rows = []
    for name, func in sorted(registered(kind).items()):
      first = 3 if kind == "events" and not inspect.isclass(func) else 0 if inspect.isclass(func) else 1
      params = ", ".join(list(inspect.signature(func).parameters)[first:])
      rows.append(f"| {_code(name)} | {_code(params)} | {_text(_summary(func))} |")
    parts.append("\n".join([f"## {kind}\n", "| function | parameters | meaning |", "|---|---|---|", *rows, ""]))
  return "\n".join(parts)


def _experiments() -> str:
  """The experiments that have no file."""
  tasks, known = task_experiments([ROOT / "configs"]), entries()
  rows = [f"| {_code(name)} | {_code(task)} | {_code(known[task].agent)} |" for name, task in sorted(tasks.items())]
  head = "Every task has an experiment of its name with its agent and tuned set. Those below have files.\n"
  return "\n".join([head, "| experiment | task | agent |", "|---|---|---|", *rows, ""])


def _class_section(name: str, cls: type) -> str:
  """The settings that a class defines."""
  head = [f"## {name}\n", f"{_text(inspect.getdoc(cls) or '')}\n"]
  rows = [_setting_row(setting) for setting in settings(cls).values() if setting.default is not dataclasses.MISSING]
  return "\n".join([*head, "| key | default | allowed | meaning |", "|---|---|---|---|", *filter(None, rows), ""])


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
