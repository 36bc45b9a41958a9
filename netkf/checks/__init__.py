"""Theory held against simulation: promises as functions that return evidence."""
