"""The command line: reads arguments, calls `run`, prints. It knows no physics."""
