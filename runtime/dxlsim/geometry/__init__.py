"""Geometry: rigid transforms, and the reader of URDF files. No other module of dxlsim is imported here."""
