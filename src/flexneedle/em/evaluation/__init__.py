"""What a table of repeated measurements reveals about a tracker."""
