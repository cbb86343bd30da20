"""The wake-up latency of this machine, measured as the loop waits: the thesis' rt_test, `dxlrun latency`."""
