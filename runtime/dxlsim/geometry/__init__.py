"""Geometry: rigid transforms, and the reader of URDF files. It imports no other module of dxlsim."""
