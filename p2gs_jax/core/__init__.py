"""What every part uses: device arrays, random streams, files, clocks."""
