"""YAML files of a few lines that stand for ten billion values: ten levels of ten aliases.

The first is slow for a reader that writes aliases out, as OmegaConf does, the second for every reader.
"""

LAUGHS = "\n".join(["a0: &a0 [1]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 11))])
MERGED = LAUGHS.replace("[1]", "{x: 1}").replace(" [", " {<<: [").replace("]", "]}")
