-- A plate's text as it is looked for: capital letters (of ASCII), without what stands between the letters.
create function plate_key(p_plate text) returns text
language sql immutable strict parallel safe as $$
  select translate(upper(p_plate collate "C"), E' \t-._/:·•', '')
$$;
