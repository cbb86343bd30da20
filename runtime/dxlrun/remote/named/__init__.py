"""Names in requests, looked up: joints, registers, commands, parameters of controllers.

Routes and replies belong in `requests`.
"""
