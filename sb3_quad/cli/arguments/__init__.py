"""The flags of each command, a module each; what it does is the module of the same name in :mod:`sb3_quad.cli.commands`."""
