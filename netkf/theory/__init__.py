"""Results of the papers, computed for scenarios and for plain matrices."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from netkf.theory.public import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """Return a public function; all are imported at the first use of one."""
    if name.startswith("__") and name != "__all__":
        raise AttributeError(f"module 'netkf.theory' has no attribute {name!r}")
    from netkf.theory.public import PUBLIC

    globals().update(PUBLIC, __all__=[*PUBLIC])
    if name not in globals():
        raise AttributeError(f"module 'netkf.theory' has no attribute {name!r}")
    return globals()[name]


def __dir__() -> list[str]:
    from netkf.theory.public import PUBLIC

    return sorted(PUBLIC)
