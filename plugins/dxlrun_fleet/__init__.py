"""Several robots and several computers: keys for their gateways, and one view of all."""
