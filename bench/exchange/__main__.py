"""What one exchange with the servos costs, ours beside dynamixel-sdk's and rustypot's; see bench.md.

python bench/exchange [--servos 1,8,20] [--protocol 1.0,2.0] [--against canned,simulated] [--json]
"""

import sys
from pathlib import Path

# Python puts the folder itself there; the package is found beside it
sys.path[0] = str(Path(__file__).resolve().parents[1])

from exchange.command import main  # noqa: E402  found by the path above

sys.exit(main())
