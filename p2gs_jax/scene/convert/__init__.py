"""Conversion of camera files to photographs that every other module can read.

PNG, JPEG and TIFF are decoded directly, and their colour profile is applied (`icc`). HEIC, camera
raw and files of linear light are written once, as PNG, into the run's cache (`convert`). Linear
light is encoded as sRGB with 16 bits, so that its tone curve is known.
"""
