import numpy as np

from p2gs_jax.paths.pictures import CaptionedImage, stacked, stacked_size


def test_images_come_through_between_lines_of_text():
    rng = np.random.default_rng(0)
    images = [np.rint(255 * rng.uniform(size=(20 + k, 300, 3))) / 255 for k in range(3)]
    captions = [("left", 0, 100), ("right", 100, 300)]
    sheet = stacked(
        [
            CaptionedImage("one", images[0], captions),
            CaptionedImage("two", images[1]),
            CaptionedImage("", images[2]),
        ]
    )
    assert sheet.shape[1::-1] == stacked_size(300, [20, 21, 22], captions=1)
    line = (sheet.shape[0] - 63) // 4
    tops = [line, 20 + 3 * line, 41 + 4 * line]
    for image, top in zip(images, tops, strict=True):
        np.testing.assert_allclose(sheet[top : top + len(image)], image, atol=1e-6)
    text = sheet[: tops[0]].min(axis=2)
    assert text.min() < 0.5  # the title is there
    assert (sheet[20 + line : 20 + 2 * line, 100].min(axis=-1) < 0.5).any()  # and the tick
    assert (sheet[41 + 3 * line : tops[2]] == 1).all()  # no title, no ink


def test_captions_that_do_not_fit_are_shortened():
    def under(text, end):
        row = CaptionedImage("", np.zeros((10, 300, 3)), [(text, 0, end)])
        return stacked([row])[10:, :].min(axis=2) < 0.9

    long = "a caption that is much too long for it"
    ink = under(long, 100)[-10:, :98]  # without the tick
    assert ink.any()
    assert not ink[:, :2].any()  # no ink beyond either edge
    np.testing.assert_array_equal(under(long, 4), under("", 4))  # not even an ellipsis fits
    assert under(long, 300).sum() > ink.sum()
