"""Adapters to the outside world. Each is the only importer of its vendor package, and imports it when opened.

What lives here: one file per package or kernel interface, and ``open`` that picks one by URI.
What must not: device knowledge, retries that hide a loss. Raises at opening, with what to do about it, when the
package or the device is absent.
"""

from hal.backends.open import open_can, open_i2c, open_serial

__all__ = ["open_can", "open_i2c", "open_serial"]
