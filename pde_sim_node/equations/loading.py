"""Which equation a name stands for: one of the project, or one from elsewhere."""

import hashlib
import importlib
import importlib.machinery
import importlib.util
import sys
from pathlib import Path
from types import CodeType, ModuleType

from .base import Equation
from .registry import EQUATIONS

__all__ = ["load_equation"]


def load_equation(name: str) -> type[Equation]:
    """The equation class that ``name`` stands for.

    Parameters
    ----------
    name
        A key of `EQUATIONS`, ``package.module:ClassName``, or ``path/to/file.py:ClassName``.

    Raises
    ------
    ValueError
        Nothing of that name can be loaded, or it is no complete `Equation`.
    """
    if name in EQUATIONS:
        return EQUATIONS[name]
    source, separator, class_name = name.rpartition(":")
    if not separator:
        raise ValueError(
            f"unknown equation {name!r}: give one of {', '.join(EQUATIONS)}, "
            "or 'package.module:ClassName', or 'path/to/file.py:ClassName'"
        )
    module = load_file(Path(source)) if source.endswith(".py") else load_module(source)
    found = getattr(module, class_name, None)
    if found is None:
        raise ValueError(f"equation {name!r}: there is no {class_name!r} in {source}")
    if not (isinstance(found, type) and issubclass(found, Equation)):
        raise ValueError(f"equation {name!r}: {class_name} must be a subclass of Equation")
    if missing := sorted(found.__abstractmethods__):
        raise ValueError(f"equation {name!r}: {class_name} does not define {', '.join(missing)}")
    if missing := [item for item in ("name", "order") if not hasattr(found, item)]:
        raise ValueError(
            f"equation {name!r}: {class_name} does not set the class attribute {', '.join(missing)}"
        )
    return found


def load_module(dotted: str) -> ModuleType:
    try:
        return importlib.import_module(dotted)
    except Exception as error:
        raise ValueError(f"the equation module {dotted!r} cannot be imported: {error}") from error


class _FreshSource(importlib.machinery.SourceFileLoader):
    """Compiles the source each time: compiled code kept beside it is told apart by time and size
    only, and an edit within the same second can leave both.
    """

    def get_code(self, fullname: str) -> CodeType | None:
        return self.source_to_code(self.get_data(self.path), self.path)


def load_file(path: Path) -> ModuleType:
    """Execute a file as a module, once for each content: an edited file is a new module."""
    if not path.is_file():
        raise ValueError(f"the equation file {str(path)!r} does not exist")
    path = path.resolve()
    # Numba keys its cache by the module's name: a name made of path and content is the same in the
    # next process, and another one after an edit.
    digest = hashlib.sha256(str(path).encode() + b"\0" + path.read_bytes()).hexdigest()[:16]
    module_name = f"equation_{path.stem}_{digest}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    loader = _FreshSource(module_name, str(path))
    spec = importlib.util.spec_from_file_location(module_name, path, loader=loader)
    if spec is None or spec.loader is None:
        raise ValueError(f"the equation file {str(path)!r} cannot be read as Python")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[module_name]
        raise ValueError(f"the equation file {str(path)!r} cannot be executed: {error}") from error
    return module
