"""Camera files, made into photographs that every other module can read.

PNG, JPEG and TIFF are decoded directly, and their colour profile is applied (`icc`). HEIC, camera
raw and files of linear light are written once, as PNG, into the run's cache (`convert`). Known
light is encoded as sRGB with 16 bits, so that photometry knows its response.
"""
