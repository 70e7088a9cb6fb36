"""Pages that `make docs` makes: the reference, from docstrings, settings classes and configs/, and the notebook's."""

import dataclasses
import functools
import inspect
import itertools
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from playground.catalog import entries
from playground.config.comments import flow, keys_and_comments, meaning
from playground.config.definitions import RunSettings, defined, definition
from playground.config.files import lineage, task_experiments
from playground.config.sweep_options import SweepConfig
from playground.envs.options import RobotKeys, TaskKeys, TermsConfig
from playground.limits import Limit
from playground.mdp.options import is_model_field
from playground.mdp.terms import MODULES, annotation, bind_one, find, registered
from playground.settings import Setting, members, settings
from playground.text import join

ROOT = Path(__file__).parents[1]
REFERENCE = "results/reference"
NOTEBOOK = ROOT / "docs/first_policy.ipynb"
# Sections of the API's reference, a page a module: modules, and packages of which every module has a page.
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
  """Puts the generated pages into the navigation, and removes links to edit a page where there is no repository."""
  assert config.nav is not None, "mkdocs.yml has one"
  api = [{title: [{name: _api_uri(name)} for name in names]} for title, names in _api().items()]
  terms = {"terms": [{kind: _uri("configs", f"terms {kind}")} for kind in MODULES]}
  config.nav.append({"Reference": [{"Python": api}, {"Configuration": [*_navigation(), terms]}]})
  if not config.repo_url:
    config.edit_uri = None  # MkDocs warns of each page's otherwise, and warnings end the build
  return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
  """Adds the generated pages."""
  names = [name for names in _api().values() for name in names]
  pages = {_api_uri(name): f"# {name}\n\n::: playground.{name}\n" for name in names}
  pages |= reference_pages() | {"first_policy.md": _notebook_page()}
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


def _api_uri(module: str) -> str:
  return _uri("api", module.replace(".", " "))


def _api() -> dict[str, list[str]]:
  """The modules of each section of `API`."""
  modules: dict[str, list[str]] = {title: [] for title in API}
  for title, names in API.items():
    for name in names:
      folder = ROOT / "playground" / name.replace(".", "/")
      inside = sorted(path.stem for path in folder.glob("*.py") if path.stem != "__init__")
      modules[title] += [f"{name}.{module}" for module in inside] or [name]
  return modules


def reference_pages() -> dict[str, str]:
  """Returns the pages of the configuration, by where they lie."""
  pages = {_uri("configs", title): _group_page(title, page) for title, page in _pages().items()}
  return pages | {_uri("configs", f"terms {kind}"): _terms_page(kind) for kind in MODULES}


def _navigation() -> list[dict[str, object]]:
  """The pages of the groups; those of a group that has several are under its name."""
  found: dict[str, list[dict[str, str]]] = {}
  for title, page in _pages().items():
    found.setdefault(page.group or "config.yaml", []).append({title: _uri("configs", title)})
  return [{name: pages if len(pages) > 1 else next(iter(pages[0].values()))} for name, pages in found.items()]


class _Page(NamedTuple):
  """The settings classes, by heading, and the files of a group that one page shows."""

  group: str
  classes: dict[str, type]
  files: list[Path]


@functools.cache
def _pages() -> dict[str, _Page]:
  """Returns the pages by title: config.yaml, then each group, with a page for each part of a long one."""
  configs = ROOT / "configs"
  of_files = {path.parent.relative_to(configs).as_posix() for path in configs.glob("*/**/*.yaml")}
  pages = {"config": _Page("", {"A run": RunSettings, "A sweep": SweepConfig}, sorted(configs.glob("*.yaml")))}
  classes = {"env": {"Tasks that are made of terms": TermsConfig, "Keys of some tasks": TaskKeys}}
  classes |= {"robot": {"A robot": RobotKeys}}
  for group in sorted(of_files | set(defined())):
    of_group = {} if group == "agent" else defined().get(group, {})
    pages[group] = _Page(group, {**of_group, **classes.get(group, {})}, [])
    if group == "agent":
      pages |= {f"agent {name}": _Page(group, {name: cls}, []) for name, cls in defined()[group].items()}
    for path in sorted((configs / group).glob("*.yaml")):
      pages.setdefault(_title(group, path), _Page(group, {}, [])).files.append(path)
  return pages


def _title(group: str, path: Path) -> str:
  """The page that shows a file: its group's, or that of its task family, robot or agent where the group's is long."""
  suite = entries()[path.stem].suite if path.stem in entries() else ""
  if group == "env":
    families = [base for base in lineage(group, path.stem, [ROOT / "configs"]) if not base[0].isupper()]
    if suite == "dm_control" or path.stem in ("_cartpole", "_finger"):
      return f"env dm_control {'A to F' if path.stem.lstrip('_').upper() < 'G' else 'H to Z'}"
    return f"env {families[-1].lstrip('_') if families else suite}" + (" tasks" if suite == "locomotion" else "")
  if group == "tuned/ppo":
    return f"{group} {suite or ('shared' if path.stem[0] == '_' else 'options')}"
  return f"agent {_agent(group, path)}" if group == "agent" else f"robot {path.stem}" if group == "robot" else group


def _group_page(title: str, page: _Page) -> str:
  """Every key of a page, those of classes first: value or default, what is allowed, meaning."""
  parts = [f"# {f'configs/{title}' if page.group else 'config.yaml'}\n"]
  parts += [_class_section(name, cls) for name, cls in page.classes.items()]
  parts += [_experiments()] if page.group == "experiment" else []
  shared_first = lambda path: (path.stem[0].isupper(), path.stem)
  parts += [_file_section(page.group, path) for path in sorted(page.files, key=shared_first)]
  others = [name for name, other in _pages().items() if other.group == page.group and name != title]
  if others and title == page.group:
    parts.append("".join(f"- [{name}]({_uri('', name).rpartition('/')[2]})\n" for name in others))
  return "\n".join(parts)


def _file_section(group: str, path: Path) -> str:
  """The keys that a file sets."""
  text = path.read_text(encoding="utf-8")
  head = list(itertools.takewhile(lambda line: line.startswith("#"), text.splitlines()))
  about = " ".join(line[1:].strip() for line in head if not line.startswith("# @package"))
  package = next((line.split()[-1] for line in head if line.startswith("# @package")), group)
  parts = [f"## {path.stem}\n\n{_text(about)}\n"]
  content = _content(path)
  bases = [base for base in content.get("defaults", []) if base != "_self_"]
  if bases:
    parts.append("On top of " + ", ".join(_code(flow(base)) for base in bases) + ".\n")
  comments = {key: comment for key, _, comment in keys_and_comments(text)}
  file = _File(group, path, "" if package == "_global_" else f"{package}.", comments)
  rows = [
    f"| {_code(key)} | {_code(value)} | {allowed} | {_text(said)} |"
    for key, value, allowed, said in file.rows({key: value for key, value in content.items() if key != "defaults"})
  ]
  if rows:
    parts.append("\n".join(["| key | value | allowed | meaning |", "|---|---|---|---|", *rows]) + "\n")
  return "\n".join(parts)


@functools.cache
def _content(path: Path) -> dict[str, Any]:
  return yaml.safe_load(path.read_text(encoding="utf-8")) or {}


class _File(NamedTuple):
  """A file of configs/; `prefix` is where its keys are in a configuration, `comments` are by its own keys."""

  group: str
  path: Path
  prefix: str
  comments: Mapping[str, str]

  def rows(self, value: object, key: str = "") -> Iterator[tuple[str, str, str, str]]:
    """Yields key, value, allowed values and meaning of each term and of each other key."""
    comment = self.comments.get(key, "")
    kind, *inside = (self.prefix + key).removeprefix("env.").split(".")
    if key and kind in MODULES and len(inside) == (2 if kind == "observations" else 1):
      yield key, flow(value), "", self._meaning_of_term(kind, key, value)
    elif isinstance(value, dict) and value:
      if comment:
        yield key, "", "", comment
      for name, inner in value.items():
        yield from self.rows(inner, join(key, str(name)))
    elif kind in MODULES and value is None:
      yield key, "null", "", "removes the group"
    elif key:
      setting = definition(self.prefix + key, {"agent": _agent(self.group, self.path)})
      yield key, flow(value), _allowed(setting) if setting else "", meaning(setting, comment)

  def _meaning_of_term(self, kind: str, key: str, entry: object) -> str:
    name = key.rpartition(".")[2]
    if entry is None:
      return "removes the term"
    if kind == "observations" and name == "state":
      return "all terms of the group state"
    comments = [text for at, text in self.comments.items() if text and (at == key or at.startswith(f"{key}."))]
    entry = {"func": name, **self._whole(key)}
    if is_model_field(name, entry):
      field = bind_one(kind, key, name, entry)().describe()
      said = f"{field['operation']} {field['field']} of {field['target']}: {field['draw']}"
    else:
      said = _summary(find(kind, entry["func"], key))
    return " ".join([said, *([f"({' '.join(comments)})"] if comments else [])])

  def _whole(self, key: str) -> dict[str, Any]:
    """A term with what the files that this one is built on say of it."""
    whole: dict[str, Any] = {}
    for base in reversed(lineage(self.group, self.path.stem, [ROOT / "configs"])):
      node: object = _content(self.path.with_stem(base))
      for part in key.split("."):
        node = node.get(part) if isinstance(node, dict) else None
      if isinstance(node, dict):
        whole |= node | {"params": whole.get("params", {}) | node.get("params", {})}
    return whole


def _agent(group: str, path: Path) -> str:
  """The agent whose keys a file sets: PPO, unless the file or its group is named after another."""
  name = group.removeprefix("tuned/") if group.startswith("tuned/") else path.stem.lstrip("_")
  return next((agent for agent in defined()["agent"] if name.startswith(agent)), "ppo")


def _summary(function: Callable[..., object]) -> str:
  """The first line of a docstring."""
  return (inspect.getdoc(function) or "").partition("\n")[0]


def _terms_page(kind: str) -> str:
  """The registered functions of a kind, with their parameters."""
  rows = []
  for name, func in sorted(registered(kind).items()):
    first = 3 if kind == "events" and not inspect.isclass(func) else 0 if inspect.isclass(func) else 1
    params = [
      _code(str(param.replace(annotation=param.empty))) + _limit(annotation(func, param))
      for param in list(inspect.signature(func).parameters.values())[first:]
      if not param.name.startswith("_")
    ]
    rows.append(f"| {_code(name)} | {', '.join(params)} | {_text(_summary(func))} |")
  head = "The registered functions. [Add a reward](../../add-a-reward.md) shows how to use them.\n"
  return "\n".join([f"# {kind}\n", head, "| function | parameters | meaning |", "|---|---|---|", *rows, ""])


def _limit(hint: object) -> str:
  """What an annotation allows, to follow the name of a parameter."""
  metadata = itertools.chain(*(getattr(kind, "__metadata__", ()) for kind in members(hint)))
  limit = next((entry for entry in metadata if isinstance(entry, Limit)), None)
  return f" ({limit})" if limit else ""


def _experiments() -> str:
  """The experiments that have no file."""
  tasks, known = task_experiments([ROOT / "configs"]), entries()
  rows = [f"| {_code(name)} | {_code(task)} | {_code(known[task].agent)} |" for name, task in sorted(tasks.items())]
  head = "Every task has an experiment of its name with its agent and tuned set. Those below have files.\n"
  return "\n".join([head, "| experiment | task | agent |", "|---|---|---|", *rows, ""])


def _class_section(name: str, cls: type) -> str:
  """The settings that a class defines."""
  parts = [f"## {name}\n\n{_text(inspect.getdoc(cls) or '')}\n"]
  rows = [_setting_row(setting) for setting in settings(cls).values() if _has_row(setting)]
  if rows:
    parts.append("\n".join(["| key | default | allowed | meaning |", "|---|---|---|---|", *rows]) + "\n")
  return "\n".join(parts)


def _has_row(setting: Setting) -> bool:
  """Whether a setting is one to set: the fields of a nested class and the keys of a mapping have rows of their own."""
  is_section = isinstance(setting.default, dict) and bool(setting.default)
  return bool(setting.help) and not is_section and not setting.name.endswith(".*")


def _setting_row(setting: Setting) -> str:
  default = "" if setting.default is dataclasses.MISSING else flow(setting.default)
  return f"| {_code(setting.name)} | {_code(default)} | {_allowed(setting)} | {_text(setting.help)} |"


def _allowed(setting: Setting) -> str:
  allowed = ", ".join(map(_code, setting.choices)) if setting.choices else str(setting.limit or "")
  return allowed + (" or null" if setting.nullable and allowed else "")


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
