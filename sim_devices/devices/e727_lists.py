"""Parameters of the emulated E-727, and the texts of its lists of commands and parameters (``HLP?``, ``HPA?``).

Source: PI E-727 manual E727T0005 (28 June 2019), parameter tables from p. 185 and p. 108; layout of the lists: GCS
commands manual PZ281E as collected from PI's client.

Model limits
- The parameters are those that our drivers and PI's client ask for, not all of the manual; values are not saved.
"""

from __future__ import annotations

TRAVEL_UM = (0.0, 15.0)
LIMIT_V = (0.0, 100.0)
SERVO_UPDATE_S = 50e-6  # manual p. 108
PARAMETERS: dict[int, tuple[float, int, str, str]] = {
    0x06000500: (0.0, 1, "INT", "ADC Channel for Target"),
    0x07000000: (TRAVEL_UM[0], 1, "FLOAT", "Range Limit min"),
    0x07000001: (TRAVEL_UM[1], 1, "FLOAT", "Range Limit max"),
    0x0C000000: (LIMIT_V[0], 1, "FLOAT", "Output Voltage Low Limit"),
    0x0C000001: (LIMIT_V[1], 1, "FLOAT", "Output Voltage High Limit"),
    0x0E000200: (SERVO_UPDATE_S, 3, "FLOAT", "Servo Update Time"),
}
"""Parameters as PI's own client asks for them, per axis: power-on value, command level for writing, type and name."""
MEANINGS = {
    "#5": "Request Motion Status",
    "#7": "Request Controller Ready Status",
    "#24": "Stop All Axes",
    "*IDN?": "Get Device Identification",
    "ATZ": "Set Automatic Zero Point Calibration",
    "ATZ?": "Get State Of Automatic Zero Point Calibration",
    "CCL": "Set Command Level",
    "CCL?": "Get Command Level",
    "CST?": "Get Assignment Of Stages To Axes",
    "CSV?": "Get Current Syntax Version",
    "ERR?": "Get Error Number",
    "FRF?": "Get Referencing Result",
    "HLP?": "Get List Of Available Commands",
    "HLT": "Halt Motion Smoothly",
    "HPA?": "Get List Of Available Parameters",
    "MOV": "Set Target Position",
    "MOV?": "Get Target Position",
    "MVR": "Set Target Relative To Current Position",
    "ONT?": "Get On-Target State",
    "OVF?": "Get Overflow State",
    "POS?": "Get Real Position",
    "PUN?": "Get Axis Unit",
    "SAI?": "Get List Of Current Axis Identifiers",
    "SPA": "Set Volatile Memory Parameters",
    "SPA?": "Get Volatile Memory Parameters",
    "STP": "Stop All Axes",
    "SVA": "Set Open-Loop Axis Value",
    "SVA?": "Get Open-Loop Axis Value",
    "SVO": "Set Servo Mode",
    "SVO?": "Get Servo Mode",
    "TAD?": "Get ADC Value Of Input Signal",
    "TMN?": "Get Minimum Commandable Position",
    "TMX?": "Get Maximum Commandable Position",
    "TPC?": "Get Number of Output Signal Channels",
    "TSC?": "Get Number of Input Signal Channels",
    "TSP?": "Get Input Signal Position Value",
    "TVI?": "Tell Valid Character Set For Axis Identifiers",
    "VEL": "Set Closed-Loop Velocity",
    "VEL?": "Get Closed-Loop Velocity",
    "VER?": "Get Versions Of Firmware And Drivers",
    "VOL?": "Get Voltage Of Output Signal Channel",
}
