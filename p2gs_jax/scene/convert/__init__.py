"""Photographs as cameras write them, made into files that everything behind can read.

PNG, JPEG and TIFF are decoded as they are; a colour profile is applied then (`icc`). HEIC, camera
raw and files of linear light are written once, as PNG, into the run's cache (`convert`). Known
light is encoded as sRGB in 16 bits, so that photometry knows its response.
"""
