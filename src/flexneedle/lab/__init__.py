"""The laboratory: studies, rigs, ROS, emulators, evaluation of trackers, and the page. The core never imports it."""
