"""OpenIGTLink: messages to and from 3D Slicer and Plus servers. Coordinates are RAS, in mm."""
