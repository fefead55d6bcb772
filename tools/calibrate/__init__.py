"""Identification: from calibration recordings to the tables that the firmware loads."""
