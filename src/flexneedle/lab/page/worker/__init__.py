"""Workers of the page: what its orders ask for, done with the functions of the package."""
