"""Names from elsewhere find their photos."""

import unicodedata

from splatpipe.pipeline.photos.files.names import NameFinder, hint_of_several, match_names

MAC = unicodedata.normalize("NFD", "flight/Münster é.JPG")
COMPOSED = unicodedata.normalize("NFC", MAC)


def test_accents_may_be_apart_or_composed() -> None:
    assert MAC != COMPOSED
    assert NameFinder([MAC])(COMPOSED) == MAC and NameFinder([COMPOSED])("münster É.jpg".upper()) == COMPOSED
    assert match_names([COMPOSED], [MAC]) == {COMPOSED: MAC}


def test_both_forms_in_one_folder_are_two_photos() -> None:
    find = NameFinder([MAC, COMPOSED])
    assert (find(MAC), find(COMPOSED)) == (MAC, COMPOSED)
    assert find(COMPOSED.upper()) is None


def test_a_name_of_several_photos_is_told_with_them() -> None:
    photos = ["100MEDIA/DJI_0005.JPG", "101MEDIA/DJI_0005.JPG", "DJI_0006.JPG", "101MEDIA/DJI_0006.JPG"]
    find = NameFinder(photos)
    assert find("DJI_0005.JPG") is None and find.several("dji_0005.jpg") == photos[:2]
    assert find("DJI_0006.JPG") == "DJI_0006.JPG" and find.several("DJI_0006.JPG") == []
    assert find.several("DJI_0007.JPG") == []
    hint = hint_of_several(["GONE.JPG", "DJI_0005.JPG"], photos)
    assert hint.startswith("DJI_0005.JPG may be 100MEDIA/DJI_0005.JPG") and "folders" in hint
    assert hint_of_several(["GONE.JPG", "DJI_0006.JPG"], photos) == ""
