"""On PYTHONPATH: Python as on the bare GPU machine. What it lacks cannot be imported, whatever is installed here.

What a visit carries is found outside this environment's folder, where the visit has unpacked it.
"""

import sys
from importlib.machinery import ModuleSpec, PathFinder

# The machine's packages that we import, and what these import.
HELD = {
    *("torch", "torchgen", "functorch", "numpy", "scipy", "cv2", "PIL", "jaxtyping", "matplotlib", "mpl_toolkits"),
    *("typer", "click", "rich", "nanobind", "cmake", "ninja", "scikit_build_core", "setuptools", "packaging"),
    *(
        "pytest",
        "_pytest",
        "py",
        "pytest_timeout",
        "hypothesis",
        "pluggy",
        "iniconfig",
        "sortedcontainers",
        "attr",
        "attrs",
    ),
    *("typing_extensions", "wadler_lindig", "pygments", "markdown_it", "mdurl", "shellingham", "xdist", "execnet"),
    *("sympy", "mpmath", "networkx", "jinja2", "markupsafe", "filelock", "fsspec", "triton", "yaml", "pip"),
    *("contourpy", "cycler", "dateutil", "kiwisolver", "pyparsing", "six", "fontTools", "_distutils_hack"),
}


class BareMachine:
    """A finder that knows no other package of this environment."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if path is not None or name in HELD or name in sys.stdlib_module_names:
            return None
        elsewhere = [place for place in sys.path if not place.startswith(sys.prefix)]
        spec = PathFinder.find_spec(name, elsewhere)
        if spec is None and PathFinder.find_spec(name) is not None:
            raise ModuleNotFoundError(f"No module named '{name}' on the GPU machine", name=name)
        return spec


sys.meta_path.insert(0, BareMachine)
