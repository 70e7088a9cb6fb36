"""From command line to configuration: finds configs/, composes it with Hydra, checks it, returns typed sections.

Only this package uses OmegaConf. Nothing here imports JAX, so that mistakes are reported at once.

Values come from, in rising precedence: the settings classes and the chosen option of every group; the tuned set of the
pair agent and env; the experiment; debug; the command line. Classes and options alone are also the schema: they define
which keys exist, and the type of each value, wherever it is set.

  definitions  the settings classes: type, default, limit and help of each key
  files        the folder configs/, its groups and options
  overrides    the command line, one `key=value` at a time
  sweeps       a command line that stands for many runs
  chains       a curriculum's stages, each a run of its own
  composition  the whole configuration of a new or resumed run
  schema       keys that exist and the types of their values
  limits       checks of choices, ranges and sizes that must divide
  run_config   the result, and how it is saved, read and shown
"""

from playground.config.chains import in_stage, stage_folders
from playground.config.composition import (
  compose,
  compose_all,
  compose_settings,
  from_saved,
  override_section,
  override_task,
  register_options,
  saved_section,
)
from playground.config.files import config_roots, options, search_path_override, task_names
from playground.config.overrides import (
  DEFAULT_EXPERIMENT,
  is_hydras,
  is_of_command,
  is_of_sweep,
  of_task,
  parse_with_hydra,
  with_default_experiment,
)
from playground.config.run_config import (
  RunConfig,
  TaskConfig,
  from_dict,
  in_order_of,
  load,
  to_yaml,
  tree,
  values_to_yaml,
)
from playground.config.sweeps import (
  check_saved_job,
  combinations,
  command_lines,
  expand,
  listed_jobs,
  split,
  varying,
  with_listed,
)
from playground.settings import config_dict
from playground.text import format_value
