"""Unattended runs of many captures: the list, the plan, Snakemake that runs it, and the status reports."""
