"""Requests to a running robot and their replies: one table for route, client and OpenAPI document.

How a request is carried out belongs in the gateway and in the loop.
"""
