"""What filters are made of whose verbs are kernels: the verbs' types and their building blocks.

``kernel`` marks a function that is compiled; its arrays hold L runs side by side along their last
axis, so that it reads entries with ``load`` and writes them with ``store``. ``Kernels`` are the
verbs of a filter, ``Record`` what its nodes know. See docs/writing_filters.md.
"""

from netkf.algorithms.kernels.estimates import copy_root, copy_vector
from netkf.algorithms.kernels.run import (
    absorb,
    carry,
    carry_mean,
    copy_estimate,
    emit,
    predict,
    predict_copy,
    predict_estimate,
    shift,
    shift_payload,
    shift_vector,
    update,
    update_estimate,
    use_reading,
)
from netkf.algorithms.records import Kernels, Record
from netkf.linalg.compiling import kernel
from netkf.linalg.lanes import (
    any_lane,
    load,
    load_flags,
    magnitude,
    root_of,
    select,
    spread,
    store,
    store_flags,
)

__all__ = [
    "Kernels",
    "Record",
    "absorb",
    "any_lane",
    "carry",
    "carry_mean",
    "copy_estimate",
    "copy_root",
    "copy_vector",
    "emit",
    "kernel",
    "load",
    "load_flags",
    "magnitude",
    "predict",
    "predict_copy",
    "predict_estimate",
    "root_of",
    "select",
    "shift",
    "shift_payload",
    "shift_vector",
    "spread",
    "store",
    "store_flags",
    "update",
    "update_estimate",
    "use_reading",
]
