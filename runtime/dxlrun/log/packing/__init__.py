"""Packing: conversion of a run's records to messages of the log, field by field.

The schemas of these messages are in `log/schemas.py`.
"""
