"""Homing offset: the key `homing_offset` of servos, with which a robot file was measured.

Angles do not depend on it, because each start takes the servo's own offset into the reference. That belongs
to `dxlwire/plan/placement.py`. A servo with another offset was calibrated by another program since, perhaps
after its horn was turned: no run starts.
"""
