"""A phone's video of the procedural town: hand-held, with automatic exposure and a tone curve.

    python experiments/phone_video.py walk.mp4
    p2gs-jax fit walk.mp4 --out runs/walk --max-width 320 --budget 5m

Somebody walks along the street, stops, looks about, and walks on; every fifth frame is blurred by
motion. `--hlg` writes HLG of 10 bits instead, without a curve of the camera's own.
"""

from __future__ import annotations

import argparse
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

from p2gs_jax.synth.build_town import build_town
from p2gs_jax.synth.sensor import photograph
from p2gs_jax.synth.settings import Sensor
from p2gs_jax.synth.tracer import Tracer

FPS = 15
# Metering: the mean luminance that the camera aims at, and how fast it follows, per frame.
AIM, FOLLOW = 0.16, 0.12
EYE = 1.6
SPEED = 1.2


def way(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return positions along the street, m, and yaws, degrees: left of the street is 90."""
    time = np.arange(frames) / FPS
    resting = (time > 0.4 * time[-1]) & (time < 0.55 * time[-1])
    position = np.cumsum(np.where(resting, 0, SPEED / FPS))
    look = np.where(resting, 12 * np.sin(np.pi * (time / time[-1] - 0.4) / 0.15), 0)
    return position, 55 + look


def viewmat(x: float, yaw: float, pitch: float) -> np.ndarray:
    """Return world-to-camera of somebody on the pavement: x forward, y left, z up."""
    a, b = np.deg2rad([yaw, pitch])
    forward = np.array([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, -rotation @ [x, -2.0, EYE]
    return out


def hlg(light: np.ndarray) -> np.ndarray:
    """Return the HLG signal of light in [0, 1] (BT.2100, table 5)."""
    x = np.clip(light, 0, 1)
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    return np.where(x <= 1 / 12, np.sqrt(3 * x), a * np.log(np.maximum(12 * x - b, 1e-6)) + c)


def main() -> None:
    """Render and encode."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--hlg", action="store_true")
    o = parser.parse_args()
    width, height = o.width, o.width * 9 // 16 // 2 * 2
    focal = 0.8 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    tracer, rng = Tracer(build_town(o.seed, "town")), np.random.default_rng(o.seed)
    position, yaw = way(o.frames)
    shake = np.cumsum(rng.normal(0, 0.15, (o.frames, 2)), 0)
    shake -= np.linspace(0, 1, o.frames)[:, None] * shake[-1]
    log_exposure = None
    with av.open(str(o.out), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "12" if o.hlg else "16"})
        stream.width, stream.height = width, height
        stream.pix_fmt = "yuv420p10le" if o.hlg else "yuv420p"
        coding = (9, 18, 1) if o.hlg else (1, 1, 1)
        context = stream.codec_context
        context.colorspace, context.color_trc, context.color_primaries = coding
        context.color_range = 1
        context.time_base = Fraction(1, FPS)
        for k in range(o.frames):
            pose = viewmat(position[k], yaw[k] + shake[k, 0], 4 + shake[k, 1])
            light, _ = tracer.render(pose, K, width, height, 2)
            if k % 5 == 3:
                light = np.mean([np.roll(light, s, axis=1) for s in range(-4, 5)], axis=0)
            wanted = np.log(AIM / np.exp(np.log(light.mean(-1) + 1e-3).mean()))
            step = 0.0 if log_exposure is None else FOLLOW * (wanted - log_exposure)
            log_exposure = wanted if log_exposure is None else log_exposure + step
            exposure = float(np.exp(log_exposure))
            if o.hlg:
                codes = np.rint(hlg(light * exposure / 4) * 65535).astype(np.uint16)
            else:
                codes = photograph(light, exposure, Sensor(curve="filmic", noise=0.5), rng=rng)
            source = "rgb48le" if o.hlg else "rgb24"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(codes), format=source)
            frame = frame.reformat(
                format=stream.pix_fmt, dst_colorspace=coding[0], dst_color_range=1
            )
            frame.pts = k
            container.mux(stream.encode(frame))
            if k % 20 == 0:
                print(f"{k} of {o.frames}, exposure {log_exposure / np.log(2):+.2f} EV", flush=True)
        container.mux(stream.encode(None))


if __name__ == "__main__":
    main()
