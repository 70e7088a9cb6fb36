"""Random keys by the name of what is drawn from them."""

from collections.abc import Iterable, Sequence

import jax


def split_keys(
  rng: jax.Array, names: Iterable[str], order: Sequence[Sequence[str]] = ()
) -> tuple[jax.Array, dict[str, jax.Array]]:
  """Splits off a key for each draw.

  Args:
    rng: random key.
    names: the draws that need a key.
    order: groups of names: each group is one split, groups come in order. They may hold names that need no key, and
      leave some out, which follow, each in a split of its own. (Playground 0.2.0's order differs between robots.)

  Returns:
    The next random key, and the keys by name.
  """
  grouped = {name for group in order for name in group}
  keys: dict[str, jax.Array] = {}
  for group in (*order, *([name] for name in names if name not in grouped)):
    rng, *drawn = jax.random.split(rng, len(group) + 1)
    keys.update(zip(group, drawn, strict=True))
  return rng, keys
