"""Requests to a running robot and their replies: one table for gateway, client and OpenAPI document.

The execution of requests belongs in the gateway and in the loop.
"""
