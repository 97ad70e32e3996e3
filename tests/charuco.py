"""A photograph of a ChArUco board, computed."""

import numpy as np
from scipy.spatial.transform import Rotation

from robust_instant_policy.geometry import make_pose, transform_points

INTRINSICS = np.array([[615.0, 0, 321.3], [0, 614.2, 238.7], [0, 0, 1]])
WIDTH, HEIGHT = 640, 480
FINER = 4  # pixels of the drawing per pixel of the image, along each edge
PATTERN_PX = 60  # per square


def photograph(board, pose, rng, intrinsics=INTRINSICS):
    """Image ``(H, W, 3)`` of a board at ``pose`` board -> camera, with noise, and its depth ``(H, W)`` in metres."""
    import cv2

    margin = PATTERN_PX // 2
    drawing = cv2.copyMakeBorder(board.pattern(PATTERN_PX), *[margin] * 4, cv2.BORDER_CONSTANT, value=255)
    scale = board.square_m / PATTERN_PX
    in_board = np.array(
        [
            [scale, 0, (0.5 - margin) * scale],
            [0, -scale, board.size[1] - (0.5 - margin) * scale],
            [0, 0, 1],
        ]
    )
    finer = np.array([[FINER, 0, (FINER - 1) / 2], [0, FINER, (FINER - 1) / 2], [0, 0, 1]])
    homography = finer @ intrinsics @ pose[:3][:, [0, 1, 3]] @ in_board
    image = cv2.warpPerspective(drawing, homography, (WIDTH * FINER, HEIGHT * FINER), borderValue=150)
    image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA) * 0.8 + 20
    image = np.clip(image + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(intrinsics).T
    normal = pose[:3, 2]
    depth = (normal @ pose[:3, 3]) / (rays @ normal)
    return np.repeat(image[..., None], 3, axis=2), depth.astype(np.float32)


def facing(board, rng, tilt_deg=35.0):
    """A pose board -> camera with the board in view, tilted at random."""
    turned = rng.uniform([-tilt_deg, -tilt_deg, -60], [tilt_deg, tilt_deg, 60])
    rotation = (Rotation.from_euler("xyz", turned, degrees=True) * Rotation.from_euler("x", np.pi)).as_matrix()
    centre = rng.uniform([-0.1, -0.06, 0.55], [0.1, 0.06, 0.8])
    return make_pose(rotation, centre - rotation @ transform_points(np.eye(4), board.outer_corners.mean(axis=0)))


def error_of(pose, true):
    """Millimetres between the origins and degrees between the axes of two poses."""
    turn = Rotation.from_matrix(pose[:3, :3].T @ true[:3, :3]).magnitude()
    return 1e3 * np.linalg.norm(pose[:3, 3] - true[:3, 3]), np.degrees(turn)
