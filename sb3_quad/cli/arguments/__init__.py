"""The flags of each command, a module each, whose docstring is the text of ``--help``.

What the command does is the module of the same name in :mod:`sb3_quad.cli.commands`.
"""
