"""Space: poses of a link instead of joint angles, by inverse kinematics on the robot's URDF.

Kinematics, solver, planned paths, the controller that plays them, and a function for Python clients. Laws of
single joints belong in `dxlrun_controllers`.
"""
