"""What filters are made of whose verbs are kernels: the verbs' types and their building blocks.

``kernel`` marks a function that is compiled; its arrays hold L runs side by side along their last
axis, so that it reads entries with ``load`` and writes them with ``store``. ``Kernels`` are the
verbs of a filter, ``Record`` what its nodes know. See docs/writing_filters.md.
"""

from netkf.algorithms.kernels.estimates import copy_root as copy_root
from netkf.algorithms.kernels.estimates import copy_vector as copy_vector
from netkf.algorithms.kernels.run import absorb as absorb
from netkf.algorithms.kernels.run import carry as carry
from netkf.algorithms.kernels.run import carry_mean as carry_mean
from netkf.algorithms.kernels.run import copy_estimate as copy_estimate
from netkf.algorithms.kernels.run import emit as emit
from netkf.algorithms.kernels.run import predict as predict
from netkf.algorithms.kernels.run import predict_copy as predict_copy
from netkf.algorithms.kernels.run import predict_estimate as predict_estimate
from netkf.algorithms.kernels.run import shift as shift
from netkf.algorithms.kernels.run import shift_payload as shift_payload
from netkf.algorithms.kernels.run import shift_vector as shift_vector
from netkf.algorithms.kernels.run import update as update
from netkf.algorithms.kernels.run import update_estimate as update_estimate
from netkf.algorithms.kernels.run import use_reading as use_reading
from netkf.algorithms.records import Kernels as Kernels
from netkf.algorithms.records import Record as Record
from netkf.linalg.compiling import kernel as kernel
from netkf.linalg.lanes import any_lane as any_lane
from netkf.linalg.lanes import load as load
from netkf.linalg.lanes import load_flags as load_flags
from netkf.linalg.lanes import magnitude as magnitude
from netkf.linalg.lanes import root_of as root_of
from netkf.linalg.lanes import select as select
from netkf.linalg.lanes import spread as spread
from netkf.linalg.lanes import store as store
from netkf.linalg.lanes import store_flags as store_flags

__all__ = [name for name in sorted(globals()) if not name.startswith("_")]
