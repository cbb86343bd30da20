"""Several robots on several computers: keys for their gateways, one view of all, agents that start runs.

Access to a single robot over the network is part of the core (`dxlrun.remote.network`).
"""
