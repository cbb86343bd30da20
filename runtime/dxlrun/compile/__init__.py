"""Compile: a robot file, motions, tables and plug-ins become a plan; every cross check is here."""
