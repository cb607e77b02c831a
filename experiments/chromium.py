"""Runs Chromium without a screen, drawing WebGL in software, for tests and measurements of the page
that shows avatars.

Debian installs it by `apt-get install chromium chromium-driver`. It is driven by selenium (extra
`dev`).
"""

import base64
import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--force-color-profile=srgb",
    "--hide-scrollbars",
    # no requests of the browser itself
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-extensions",
    "--disable-quic",
    "--disable-sync",
    "--no-first-run",
)
PATIENCE = 300.0
"""Seconds that a script may take: software WebGL is slow on a busy machine."""


def missing() -> str | None:
    """Returns why there is no browser to test in, or None if there is one."""
    if not any(map(shutil.which, BROWSERS)) or not shutil.which("chromedriver"):
        return f"needs a browser ({', '.join(BROWSERS)}) and chromedriver on the PATH"
    try:
        import selenium  # noqa: F401
    except ImportError:
        return "needs selenium"
    return None


class Chromium:
    """A browser with one page. It is a context manager, which quits the browser."""

    def __init__(
        self, width: int = 1280, height: int = 800, pixel_ratio: float = 1.0, mobile: bool = False
    ):
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service

        options = webdriver.ChromeOptions()
        options.binary_location = next(path for path in map(shutil.which, BROWSERS) if path)
        for flag in FLAGS:
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
        self.driver = webdriver.Chrome(
            options=options, service=Service(shutil.which("chromedriver"))
        )
        self.driver.set_script_timeout(PATIENCE)
        client = self.driver.command_executor
        assert not isinstance(client, str)  # Chrome's is an object
        client.client_config.timeout = PATIENCE + 30
        self.resize(width, height, pixel_ratio, mobile)

    def __enter__(self) -> "Chromium":
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.quit()

    def resize(
        self, width: int, height: int, pixel_ratio: float = 1.0, mobile: bool = False
    ) -> None:
        """Sets the size of the page in CSS pixels, and the screen's pixels per CSS pixel."""
        metrics = {
            "width": width,
            "height": height,
            "deviceScaleFactor": pixel_ratio,
            "mobile": mobile,
        }
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)

    def open(self, page: Path | str) -> None:
        """Loads a file or an address and waits for the first image.

        Raises: RuntimeError with the message of the page.
        """
        self.driver.get(page.resolve().as_uri() if isinstance(page, Path) else page)
        problem = self.run("return humangs.ready.then(() => null, (error) => String(error))")
        if problem is not None:
            raise RuntimeError(problem)

    def run(self, script: str, *arguments: Any) -> Any:
        """Runs the body of an async function in the page and returns its value.

        The script has the arguments as `given`. Promises are awaited.

        Raises: RuntimeError if the script throws.
        """
        code = "const done = arguments[arguments.length - 1], given = [...arguments].slice(0, -1);"
        code += (
            f"(async () => {{ {script} }})().then((v) => done([v, null]), (e) => done([null,"
            " String(e.stack || e)]))"
        )
        value, error = self.driver.execute_async_script(code, *arguments)
        if error is not None:
            raise RuntimeError(error)
        return value

    def screenshot(self) -> np.ndarray:
        """Returns what the window shows, (h, w, 3) in [0, 1]."""
        from PIL import Image

        data = base64.b64decode(self.driver.get_screenshot_as_base64())
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), np.float32) / 255

    def problems(self) -> list[str]:
        """Returns the errors and warnings on the console since the last call.

        Notes that reading pixels back is slow are left out, because tests do so on purpose.
        """
        entries = self.driver.get_log("browser")
        return [
            entry["message"]
            for entry in entries
            if "GPU stall due to ReadPixels" not in entry["message"]
        ]
