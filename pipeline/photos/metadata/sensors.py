"""Sensor sizes of drone cameras, for focal lengths in pixels where a photo's metadata have only millimetres.

Sizes are those of the makers' specifications (or of the sensor type they name: 1/2.3", 1", 4/3, APS-C), in millimetres,
in landscape. The 1/2.3" size of DJI's FC300S and FC330 was checked against calibrations.
"""

from __future__ import annotations

INCH_2_3 = (6.17, 4.63)  # type 1/2.3"
INCH_2_0 = (6.40, 4.80)  # type 1/2"
INCH_1_3 = (9.60, 7.20)  # type 1/1.3"
INCH_1 = (13.20, 8.80)  # type 1"
FOUR_THIRDS = (17.30, 13.00)
APS_C = (23.50, 15.60)
FULL_FRAME = (35.90, 24.00)

SENSOR_MM = {
    ("dji", "fc220"): INCH_2_3,  # Mavic Pro
    ("dji", "fc200"): INCH_2_3,  # Phantom 2 Vision
    ("dji", "fc300c"): INCH_2_3,  # Phantom 3 Standard
    ("dji", "fc300s"): INCH_2_3,  # Phantom 3 Advanced
    ("dji", "fc300se"): INCH_2_3,  # Phantom 3 SE
    ("dji", "fc300x"): INCH_2_3,  # Phantom 3 Professional
    ("dji", "fc330"): INCH_2_3,  # Phantom 4
    ("dji", "fc350"): INCH_2_3,  # Zenmuse X3
    ("dji", "fc1102"): INCH_2_3,  # Spark
    ("dji", "fc2103"): INCH_2_3,  # Mavic Air
    ("dji", "fc2204"): INCH_2_3,  # Mavic 2 Zoom
    ("dji", "fc2403"): INCH_2_3,  # Mavic 2 Enterprise Dual
    ("dji", "fc7203"): INCH_2_3,  # Mavic Mini
    ("dji", "fc7303"): INCH_2_3,  # Mini 2
    ("dji", "fc7503"): INCH_2_3,  # Mini SE
    ("dji", "fc3170"): INCH_2_0,  # Mavic Air 2
    ("dji", "m3t"): INCH_2_0,  # Mavic 3 Thermal, wide
    ("dji", "fc3582"): INCH_1_3,  # Mini 3 Pro
    ("dji", "fc8482"): INCH_1_3,  # Mini 4 Pro
    ("dji", "fc8282"): INCH_1_3,  # Air 3
    ("dji", "fc3411"): INCH_1,  # Air 2S
    ("dji", "fc6310"): INCH_1,  # Phantom 4 Pro
    ("dji", "fc6310r"): INCH_1,  # Phantom 4 RTK
    ("dji", "fc6310s"): INCH_1,  # Phantom 4 Pro V2
    ("dji", "fc6510"): INCH_1,  # Zenmuse X4S
    ("hasselblad", "l1d-20c"): INCH_1,  # Mavic 2 Pro
    ("dji", "fc550"): FOUR_THIRDS,  # Zenmuse X5
    ("dji", "fc550r"): FOUR_THIRDS,  # Zenmuse X5R
    ("dji", "fc6520"): FOUR_THIRDS,  # Zenmuse X5S
    ("dji", "m3e"): FOUR_THIRDS,  # Mavic 3 Enterprise
    ("hasselblad", "l2d-20c"): FOUR_THIRDS,  # Mavic 3
    ("dji", "fc6540"): APS_C,  # Zenmuse X7
    ("dji", "zenmusep1"): FULL_FRAME,
    ("autel robotics", "xt701"): INCH_2_0,  # EVO II
    ("autel robotics", "xt705"): INCH_1,  # EVO II Pro
    ("parrot", "anafi"): (5.87, 4.40),
    ("sony", "ilce-6000"): (23.50, 15.60),
    ("sony", "ilce-7rm4"): (35.70, 23.80),
    ("sony", "dsc-rx1rm2"): FULL_FRAME,
    ("canon", "canon powershot a3300 is"): INCH_2_3,
    ("canon", "canon eos digital rebel xsi"): (22.20, 14.80),
}


def sensor_size_mm(make: str, model: str) -> tuple[float, float] | None:
    """Width and height of a camera's sensor in landscape, millimetres; None when it is not in the table."""
    return SENSOR_MM.get((make.casefold(), model.casefold()))
