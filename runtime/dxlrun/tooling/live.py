"""Live: running robots, local or over the network.

`dxlrun.connect` steers one robot. These names are for programs that serve others, or watch several robots.

    from dxlrun import connect, running
    from dxlrun.tooling.live import RobotInfo

    info: RobotInfo = connect().info()
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from dxlwire.faces import lazy_face

if TYPE_CHECKING:
    from dxlrun.channels.answers import Code as Code
    from dxlrun.errors import RunGone as RunGone
    from dxlrun.remote.client import Executed as Executed
    from dxlrun.remote.live.live_messages import LiveMessages as LiveMessages
    from dxlrun.remote.live.states import RobotStates as RobotStates
    from dxlrun.remote.named.named_joints import joint_servos as joint_servos
    from dxlrun.remote.network.certificates import CLIENT as CLIENT
    from dxlrun.remote.network.certificates import client_context as client_context
    from dxlrun.remote.network.certificates import keys_place as keys_place
    from dxlrun.remote.network.certificates import revoked as revoked
    from dxlrun.remote.network.certificates import server_context as server_context
    from dxlrun.remote.network.listener import ListenAddress as ListenAddress
    from dxlrun.remote.network.listener import Listener as Listener
    from dxlrun.remote.network.listener import in_url as in_url
    from dxlrun.remote.network.network_link import NetworkLink as NetworkLink
    from dxlrun.remote.network.robots_file import ListedAddress as ListedAddress
    from dxlrun.remote.requests.replies import ControllerInfo as ControllerInfo
    from dxlrun.remote.requests.replies import Events as Events
    from dxlrun.remote.requests.replies import JointServo as JointServo
    from dxlrun.remote.requests.replies import Parameter as Parameter
    from dxlrun.remote.requests.replies import RobotInfo as RobotInfo
    from dxlrun.remote.requests.request_table import Role as Role
    from dxlrun.remote.server import serve_clients as serve_clients
    from dxlrun.remote.sockets import Address as Address
    from dxlrun.remote.sockets import SocketLink as SocketLink
    from dxlrun.remote.sockets import sockets as sockets
else:
    __getattr__, __dir__ = lazy_face(__name__, __file__)
