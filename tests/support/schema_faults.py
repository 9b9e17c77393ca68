"""Messages on contents that do not match a schema."""

from dvrk_drake.errors import ArmError
from dvrk_drake.models.typed_yaml import typed_content


def schema_fault(schema, content):
    """Returns the message that refuses parsed content, or "" if it is accepted."""
    try:
        typed_content(schema, content, "here", ArmError, "a test")
    except ArmError as error:
        return str(error).removeprefix("here: ")
    return ""
