"""What a servo can do, measured: response, speed, dead band, the rate and the gaps between commands."""
