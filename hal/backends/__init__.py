"""Adapts vendor packages to the contracts. Each adapter alone imports its package, when it is opened.

What lives here: one file per package or kernel interface, and ``open`` that picks one by URI.
What must not: device knowledge, retries that hide a loss. Raises at opening, with what to do about it, when the
package or the device is absent.
"""

from hal.backends.open import open_can, open_i2c, open_serial

__all__ = ["open_can", "open_i2c", "open_serial"]
