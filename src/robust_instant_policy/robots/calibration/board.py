"""The ChArUco board: its print, and its corners in an image."""

import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from robust_instant_policy.errors import CalibrationError, InvalidValueError, needs_extra
from robust_instant_policy.geometry import FloatArray

MIN_CORNERS = 8  # of a board in an image
PRINT_DPI = 300
MARGIN_M = 0.015  # around the printed pattern, for the corners' letters and the ruler
RULER_M = 0.1
INCH_M = 0.0254
DICTIONARIES = ("4X4_50", "4X4_250", "5X5_100", "5X5_250", "6X6_250", "APRILTAG_36h11")  # tried to name a wrong one


@dataclass(frozen=True)
class BoardView:
    """Corners of a board in an image: ``ids (N,)``, ``points (N, 3)`` in the board's frame (metres), ``pixels (N, 2)``
    (column, row; pixel centres are integers)."""

    ids: NDArray[np.intp]
    points: FloatArray
    pixels: FloatArray


@dataclass(frozen=True)
class Board:
    """A ChArUco board of ``columns`` x ``rows`` squares with edges of ``square_m`` metres.

    Its frame: origin at the lower left corner of the print (A), x along the lower edge to B, y up to D, z out of the
    paper. The outer corners A, B, C, D run counterclockwise.
    """

    columns: int = 7
    rows: int = 5
    square_m: float = 0.035
    marker_m: float = 0.026
    dictionary: str = "4X4_50"

    def __post_init__(self) -> None:
        if not (0.002 < self.marker_m < self.square_m < 0.3):
            raise InvalidValueError(
                f"a board with squares of {self.square_m:g} m and markers of {self.marker_m:g} m: both are edge "
                "lengths in metres, such as 0.035 and 0.026, and a marker is smaller than its square"
            )
        if min(self.columns, self.rows) < 3:
            raise InvalidValueError(f"a board of {self.columns} x {self.rows} squares: it needs at least 3 x 3")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern in metres."""
        return self.columns * self.square_m, self.rows * self.square_m

    @property
    def outer_corners(self) -> FloatArray:
        """A, B, C, D ``(4, 3)`` in the board's frame, metres."""
        width, height = self.size
        return np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0.0]])

    def find(self, image: NDArray[np.uint8]) -> BoardView:
        """The board's corners in ``image (H, W, 3)`` RGB; raises `CalibrationError` that says why there are too few."""
        view, markers = self._detect(image, self.dictionary)
        if view is not None:
            return view
        mirrored, _ = self._detect(np.ascontiguousarray(image[:, ::-1]), self.dictionary)
        if mirrored is not None:
            raise CalibrationError(
                "the board is seen mirrored: the image is flipped (switch that off in the camera's driver) "
                "or the board was printed mirrored"
            )
        if markers >= 4:
            raise CalibrationError(
                f"{markers} markers were found, but they do not form a board of {self.columns} x {self.rows} squares; "
                "is it another board, are rows and columns exchanged, or is it partly hidden?"
            )
        for other in DICTIONARIES:
            if other != self.dictionary and self._detect(image, other)[1] >= 4:
                raise CalibrationError(f"the board's markers are of dictionary {other}, not {self.dictionary}")
        raise CalibrationError(
            "no board was found in the image; it must be in view, sharp, evenly lit, and at least a fifth as wide as "
            "the image"
        )

    def pattern(self, pixels_per_square: int) -> NDArray[np.uint8]:
        """The pattern as an image ``(H, W)``, without margin."""
        cv2, board = opencv(), self._opencv(self.dictionary)
        side = round(pixels_per_square * self.marker_m / self.square_m)
        image = np.zeros((self.rows * pixels_per_square, self.columns * pixels_per_square), np.uint8)
        # Not by OpenCV's generateImage: version 5.0 fails for sizes whose markers are no whole number of pixels.
        for marker, corners in zip(board.getIds().ravel(), board.getObjPoints(), strict=True):
            column, row = np.floor(np.mean(corners, axis=0)[:2] / self.square_m).astype(int) * pixels_per_square
            image[row : row + pixels_per_square, column : column + pixels_per_square] = 255
            row, column = (start + (pixels_per_square - side) // 2 for start in (row, column))
            image[row : row + side, column : column + side] = cv2.aruco.generateImageMarker(
                board.getDictionary(), int(marker), side, borderBits=1
            )
        return image

    def page(self, kind: str) -> bytes:
        """The page to print without scaling, as a ``kind`` "png" or "pdf": pattern, corners' letters, 100 mm ruler."""
        per_metre = PRINT_DPI / INCH_M
        square, margin = round(self.square_m * per_metre), round(MARGIN_M * per_metre)
        pattern = self.pattern(square)
        page = Image.new("L", (pattern.shape[1] + 2 * margin, pattern.shape[0] + 2 * margin), 255)
        page.paste(Image.fromarray(pattern), (margin, margin))
        draw, font = ImageDraw.Draw(page), ImageFont.load_default(size=margin * 0.45)
        right, bottom = margin + pattern.shape[1], margin + pattern.shape[0]
        corners = {"A": (margin, bottom), "B": (right, bottom), "C": (right, margin), "D": (margin, margin)}
        for letter, (x, y) in corners.items():
            offset = margin * 0.4
            at = (x + (offset if x == right else -offset), y + (offset if y == bottom else -offset))
            draw.text(at, letter, fill=0, font=font, anchor="mm")
        start, end, line = margin * 2, margin * 2 + round(RULER_M * per_metre), bottom + margin * 0.4
        draw.line([(start, line), (end, line)], fill=0, width=3)
        for x in (start, end):
            draw.line([(x, line - margin * 0.15), (x, line + margin * 0.15)], fill=0, width=3)
        words = (
            f"100 mm when printed without scaling; square {self.square_m * 1e3:g} mm, marker {self.marker_m * 1e3:g} mm"
        )
        draw.text((start, line + margin * 0.2), words, fill=0, font=ImageFont.load_default(size=margin * 0.25))
        out = io.BytesIO()
        scale = square / (self.square_m * per_metre)  # squares are whole pixels
        page.save(out, kind, dpi=(PRINT_DPI * scale,) * 2, resolution=PRINT_DPI * scale)
        return out.getvalue()

    def _detect(self, image: NDArray[np.uint8], dictionary: str) -> tuple[BoardView | None, int]:
        """The view, or None with fewer than `MIN_CORNERS` corners, and the number of markers."""
        cv2 = opencv()
        detector = cv2.aruco.CharucoDetector(self._opencv(dictionary))
        pixels, ids, _, markers = detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        count = 0 if markers is None else len(markers)
        if ids is None or len(ids) < MIN_CORNERS:
            return None, count
        ids = ids.ravel().astype(np.intp)
        row, column = np.divmod(ids, self.columns - 1)  # row 0 is at the top of the print
        points = np.stack([column + 1, self.rows - 1 - row, np.zeros(len(ids))], axis=1) * self.square_m
        return BoardView(ids, points, pixels.reshape(-1, 2).astype(np.float64)), count

    def _opencv(self, dictionary: str) -> Any:
        cv2 = opencv()
        known = getattr(cv2.aruco, f"DICT_{dictionary}", None)
        if known is None:
            raise InvalidValueError(f"unknown dictionary {dictionary!r}; known are {', '.join(DICTIONARIES)}")
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_m, self.marker_m, cv2.aruco.getPredefinedDictionary(known)
        )


def opencv() -> Any:
    """The module ``cv2``; raises `MissingExtraError` or `RobotError` where it cannot be imported."""
    with needs_extra("robots", library="libgl1"):
        import cv2
    return cv2
