"""The commands of `rip`, one file each: ``add_arguments(parser)`` and ``run(options) -> exit status``."""
