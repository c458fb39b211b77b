"""Stage `masks`: the object in every frame, imported or cut out."""
