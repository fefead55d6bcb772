"""Published tremor estimators that results compare the instrument's own with.

What lives here: one file per family, as a plug-in of ``micron.estimators``; ``tools/start/micron_research.dist-info``
names them, so every process of a source tree finds them, and none of an installed wheel does.
What must not: the instrument's own methods (``firmware_py/tremor``), and figures.
"""

BASELINES = ("kalman", "bmflc", "ebmflc", "bmflc_kalman", "ar_kalman")
"""Methods that this folder adds to those of ``firmware_py.tremor.config.METHODS``. Options are in
``[firmware.tremor.own]``."""
