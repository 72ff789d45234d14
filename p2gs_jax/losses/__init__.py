"""What a step minimises: the photograph, relative exposures, gauges."""
