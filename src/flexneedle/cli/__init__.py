"""The command line: reads arguments, calls, prints. It knows no physics."""
