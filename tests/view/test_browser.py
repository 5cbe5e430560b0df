"""What a user sees and does in a browser; slow there, so all of it on one page for each kind."""

import io

import numpy as np
import trimesh
from PIL import Image
from support.places import TINY_SHARD

SHARD = TINY_SHARD


def orange(picture: Image.Image) -> int:
    """Pixels in the colour of the object."""
    r, _, b = np.moveaxis(np.asarray(picture.convert("RGB")).astype(int), -1, 0)
    return int((r - b > 60).sum())


def screen(page) -> Image.Image:
    return Image.open(io.BytesIO(page.screenshot()))


def control(page, label: str):
    """The input beside a label."""
    return page.get_by_text(label, exact=True).locator("xpath=following::input[not(@type='hidden')][1]")


def test_rows_of_a_shard(opened, page):
    site, view = opened(SHARD)
    tab = page(site)
    assert orange(screen(tab)) > 50
    tab.get_by_text("next").click()
    tab.get_by_text("row 1", exact=True).wait_for()
    tab.get_by_text("link to this row").click()  # the page is loaded again
    tab.get_by_text("row 1", exact=True).wait_for()
    where, apply = control(tab, "where"), tab.get_by_role("button", name="apply")
    where.fill("metrics/nothing > 0.1")
    apply.click()
    tab.get_by_text("no column 'metrics/nothing'").filter(has_text="still shown: all rows").wait_for()
    where.fill("metrics/epsilon > 0.1")
    apply.click()
    tab.get_by_text("row 1", exact=True).wait_for(state="detached")
    with tab.expect_download() as download:
        tab.get_by_text("save model (GLB)").click()
    model = trimesh.load_scene(download.value.path(), file_type="glb")
    assert len(model.geometry) == len(view.meshes().geometry) > 10
    with tab.expect_download() as download:
        tab.get_by_text("save picture (PNG)").click()
    with Image.open(download.value.path()) as picture:
        assert orange(picture) > 50
        assert picture.getpixel((0, 0)) == (255, 255, 255)
    tab.goto(f"{tab.url}row/7")  # which does not meet the condition
    tab.get_by_text("row 7", exact=True).wait_for()
    assert control(tab, "where").input_value() == ""


def test_a_hand_moves(opened, page):
    site, _ = opened("allegro")
    tab = page(site)
    before = np.asarray(screen(tab).convert("L")).astype(int)
    tab.get_by_text("random posture").click()
    for _ in range(40):
        after = np.asarray(screen(tab).convert("L")).astype(int)
        if (np.abs(after - before)[:, :270] > 40).sum() > 50:  # beside the controls
            return
    raise AssertionError("the picture stays the same")
