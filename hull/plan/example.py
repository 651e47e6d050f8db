"""A plan to begin with."""

EXAMPLE = """\
# What a rig that is only drawn will be able to tell: hybridve plan plan.toml
# Metres in the room: Z up from the floor. Keys that are commented out stand at their defaults.
format = "hybridve-plan"
version = 1

[volume]                            # where hands will work
low_m = [-0.6, -0.6, 0.4]
high_m = [0.6, 0.6, 1.6]

[target]                            # the board, as in a session.toml
kind = "chessboard"
columns = 8
rows = 5
square_mm = 100

[ring]                              # cameras on a circle, all looking at one point
cameras = 4
radius_m = 2.5
height_m = 2.2
# other_height_m = 1.0              # every second one at another height
looks_at_m = [0.0, 0.0, 0.8]
# first_deg = 45.0
# over_deg = 360.0                  # cameras on an arc of it

# [[camera]]                        # or, or besides, one by one
# name = "above"
# at_m = [0.0, 0.0, 3.2]
# looks_at_m = [0.0, 0.0, 0.8]
# roll_deg = 0.0

# [lens]                            # a camera may have its own
# size_px = "1920x1080"
# across_deg = 70.0                 # angle of view from the left edge to the right

# [calibration]
# stills = 30                       # of the board in hand, for each camera
# moved = 0                         # places to which the board is carried, for all cameras at once
# lies_at_m = [0.0, 0.0, 0.0]       # the middle of the board on the floor
# corner_px = 0.2                   # how exactly its corners are found

# [silhouettes]
# outline_px = 1.5                  # how exactly outlines are found: 1.5 is measured on recordings

# [ball]
# radius_mm = 45.0                  # a fist; 8 is a finger

# [timing]
# speed_m_s = 1.0                   # of a hand
# exposure_ms = 4.0
# out_of_step_ms = 0.0              # between cameras
# fps = 50.0
"""
