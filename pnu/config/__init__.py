"""From conf/ and a command line to a checked config: composing, schema, help, objects from `_target_`."""
