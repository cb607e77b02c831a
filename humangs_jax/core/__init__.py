"""Array types and axes, configurations with ranges and JSON, registries, checks of arguments,
compilation, processes.
"""
