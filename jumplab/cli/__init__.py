"""The command line: what is typed comes in, text, a result folder and an exit code go out. Start
reading in ``main``.

``options.toml`` lists what can be typed, ``common`` makes parsers of it; ``jumps``, ``studies`` and
``robots`` hold the commands, ``notebooks`` finds the others, which stand beside the notebooks.
"""

from jumplab.cli.notebooks import check_parameters as check_parameters
from jumplab.cli.notebooks import find_notebooks as find_notebooks
